"""Pipeline from measurements to poses, and their reference point: shared by the configuration of a master and by scenarios."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from tsgt.config.base import Model, NotNegative, Place, Positive
from tsgt.model import ROBOT_FRAME, ReferencePoint, Row4

# The limits of the estimator, see MotionPrior.
Acceleration = Annotated[float, Field(ge=1e-6, le=1e6)]
PerAxis = tuple[Acceleration, Acceleration, Acceleration]
Delay = Annotated[float, Field(ge=1e-3, le=60)]
Lasting = Annotated[float, Field(ge=1e-3, le=1e4)]

MAX_DELAYS = 4  # each costs as much as the predictions


class MotionConfig(Model):
    """Motion prior of the estimator ``continuous``; `tsgt process` prints the one tuned to a recording."""

    acceleration_sigma_mps2: PerAxis = (0.4, 0.4, 0.2)
    """One sigma of the acceleration of the prisms' centroid along x, y, z of station 1."""
    acceleration_correlation_time_s: Lasting = 0.8
    """Correlation time of the acceleration."""
    angular_acceleration_sigma_radps2: PerAxis = (0.15, 0.15, 0.2)
    """One sigma of the angular acceleration about x, y, z of the robot."""
    angular_acceleration_correlation_time_s: Lasting = 0.4
    """Correlation time of the angular acceleration."""


class PipelineConfig(Model):
    """Pipeline from measurements to poses."""

    estimator: Literal["linear", "continuous"] = "continuous"
    """Estimator: linear interpolation between measurements, or one smooth trajectory."""
    rate_hz: Annotated[float, Field(ge=0.01, le=1000)] = 20.0
    """Poses per second; with an IMU, whose samples say what the robot does in between, 20 to 100."""
    outage_limit_s: Positive = 1.0
    """Longest gap between two measurements of a prism before it counts as missing: `linear` gives no valid pose then, `continuous`
    degraded ones while their sigmas are within the limits."""
    transport_limit_s: Positive = 2.0
    """Maximum time that a pose waits for a measurement; for `linear`."""
    residual_limit_mm: Positive = 50.0
    """Maximum layout residual of a valid pose (root mean square)."""
    tilt_limit_deg: Annotated[float, Field(gt=0, le=180)] = 90.0
    """Maximum tilt of a valid pose; more indicates a mirrored layout or swapped prisms."""
    acceleration_sigma_mps2: NotNegative = 0.3
    """One sigma of the robot's acceleration between two measurements, per axis; for `linear`."""
    angular_acceleration_sigma_radps2: NotNegative = 0.15
    """One sigma of the robot's angular acceleration, per axis; for `linear`."""
    motion: MotionConfig = MotionConfig()
    """Motion prior; for `continuous`."""
    noise_scale: Annotated[float, Field(ge=0.001, le=1000)] = 1.0
    """Factor on the noise of all instruments; for `continuous`."""
    lag_s: Annotated[float, Field(gt=0, le=60)] = 3.0
    """Lag after which a live pose is smoothed and final; for `continuous`."""
    smoothed_delays_s: Annotated[tuple[Delay, ...], Field(max_length=MAX_DELAYS)] = (1.0,)
    """Delays below `lag_s` after which a live pose is smoothed by what has arrived; for `continuous`."""
    position_sigma_limit_mm: Positive = 50.0
    """Maximum position sigma of a valid smoothed pose, at the reference point; for `continuous`."""
    rotation_sigma_limit_deg: Annotated[float, Field(gt=0, le=180)] = 2.0
    """Maximum rotation sigma of a valid smoothed pose; for `continuous`."""
    predicted_position_sigma_limit_mm: Positive = 150.0
    """Maximum position sigma of a valid predicted pose, at the reference point; for `continuous`."""
    predicted_rotation_sigma_limit_deg: Annotated[float, Field(gt=0, le=180)] = 5.0
    """Maximum rotation sigma of a valid predicted pose; for `continuous`."""

    @model_validator(mode="after")
    def _delays_are_below_the_lag(self) -> PipelineConfig:
        delays_s = self.smoothed_delays_s
        delays_ns = [round(delay_s * 1e9) for delay_s in delays_s]
        if len(set(delays_ns)) < len(delays_ns):
            raise ValueError("smoothed_delays_s: each delay must be given once")
        lag_ns = round(self.lag_s * 1e9)
        if "smoothed_delays_s" in self.model_fields_set and max(delays_ns, default=-1) >= lag_ns:
            raise ValueError(
                f"smoothed_delays_s: {max(delays_s):g} is not below lag_s ({self.lag_s:g}), after which poses are final"
            )
        return self


class ReferencePointConfig(Model):
    """Frame on the robot whose pose is streamed, recorded and exported: of a sensor, for example."""

    name: str = ROBOT_FRAME
    """Name of the frame; the robot frame's own name unless another one is given. That of the IMU (`imu.name`) without the next
    keys: the IMU's own frame."""
    position_m: Place = (0.0, 0.0, 0.0)
    """Its origin in the robot frame, [x, y, z]."""
    orientation_xyzw: Row4 = (0.0, 0.0, 0.0, 1.0)
    """Unit quaternion [x, y, z, w] that rotates its coordinates into the robot frame."""

    @model_validator(mode="after")
    def _possible(self) -> ReferencePointConfig:
        self.point()
        return self

    def point(self) -> ReferencePoint:
        """Return the point. Raises ValueError if there is none such."""
        return ReferencePoint(
            name=self.name, position_m=self.position_m, orientation_xyzw=self.orientation_xyzw
        )
