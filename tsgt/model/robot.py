"""The robot: its prisms, its reference point, its IMU, its wheels."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tsgt.model.values import (
    FRAME_NAME,
    OTHER_FRAME,
    ROBOT_FRAME,
    ROTATION_TOLERANCE,
    FiniteNumbers,
    Row4,
    Vector3,
    check_coordinates,
    check_limits,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PrismPosition(FiniteNumbers):
    """The position of a prism on the robot."""

    prism: int
    """Number of the prism, from 1."""
    position_m: Vector3
    """Its centre in the frame ``robot``, [x, y, z] in m."""

    def __post_init__(self) -> None:
        """Reject impossible positions."""
        check_coordinates("position_m", self.position_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferencePoint(FiniteNumbers):
    """The frame on the robot whose pose is exported: the robot frame, or one fixed to it."""

    name: str = ROBOT_FRAME
    """Name of the frame: ``child_frame`` of the poses."""
    position_m: Vector3 = (0.0, 0.0, 0.0)
    """Its origin in the frame ``robot``, [x, y, z] in m."""
    orientation_xyzw: Row4 = (0.0, 0.0, 0.0, 1.0)
    """Rotation that takes its coordinates to the frame ``robot``, as a Hamilton unit quaternion [x, y, z, w]."""

    def __post_init__(self) -> None:
        """Reject impossible frames."""
        check_coordinates("position_m", self.position_m)
        if not abs(math.hypot(*self.orientation_xyzw) - 1.0) < ROTATION_TOLERANCE:
            raise ValueError(f"orientation_xyzw holds {self.orientation_xyzw}, expected a unit quaternion")
        if not FRAME_NAME.fullmatch(self.name):
            raise ValueError(
                f"name holds {self.name!r}, expected a letter and then letters, digits, _ . / or -"
            )
        if OTHER_FRAME.fullmatch(self.name):
            raise ValueError(f"name holds {self.name!r}, which is another frame; choose another name")
        identity = not any(self.position_m) and not any(self.orientation_xyzw[:3])
        if self.name == ROBOT_FRAME and not identity:
            raise ValueError(f"{ROBOT_FRAME} is the robot frame itself; give another point another name")


ROBOT_ORIGIN = ReferencePoint()
"""The robot frame itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuNoise(FiniteNumbers):
    """One-sigma noise of an inertial measurement unit, per axis, in the form of its data sheet."""

    gyro_noise_density: float
    """White noise of the angular rate in rad/s/sqrt(Hz)."""
    accelerometer_noise_density: float
    """White noise of the specific force in m/s^2/sqrt(Hz)."""
    gyro_bias_walk: float
    """Random walk of the gyro's bias in rad/s/sqrt(s)."""
    accelerometer_bias_walk: float
    """Random walk of the accelerometer's bias in m/s^2/sqrt(s)."""
    gyro_bias_radps: float
    """Bias of the gyro after switching on, in rad/s."""
    accelerometer_bias_mps2: float
    """Bias of the accelerometer after switching on, in m/s^2."""
    gyro_scale_misalignment: float = 1e-4
    """Error of each entry of ``ImuParameters.gyro_matrix``: of its calibration, and by temperature since."""
    accelerometer_scale_misalignment: float = 7e-4
    """Error of each entry of the accelerometer's matrix of scale factors and misalignment, which is not calibrated."""

    def __post_init__(self) -> None:
        """Reject noise that no instrument has."""
        for name in self.__slots__:
            if not 0 < getattr(self, name) <= 1e3:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0 and at most 1000")


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuParameters(FiniteNumbers):
    """Parameters that put the samples of the robot's IMU beside the measurements of the stations."""

    name: str = "imu"
    """Name of its frame, whose pose may be exported."""
    position_m: Vector3
    """Origin of its axes (of its accelerometers) in the frame ``robot``, [x, y, z] in m."""
    orientation_xyzw: Row4
    """Rotation that takes coordinates in its axes to the frame ``robot``, as a Hamilton unit quaternion [x, y, z, w]."""
    latency_ns: int = 0
    """From a sample to its stamp, in ns; subtracted from the stamp. Positive: the stamp is late."""
    gyro_matrix: tuple[Vector3, Vector3, Vector3] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Scale factors and misalignment: the angular rate is this matrix times the sample, less the bias."""
    noise: ImuNoise
    """Noise of the samples."""
    gravity_mps2: float = 9.81
    """Magnitude of gravity where the robot drives, in m/s^2."""
    tilt_sigma_rad: float = 1e-4
    """One sigma, per horizontal axis, of the angle between the z axis of frame ``station1`` and the vertical."""
    shocks_before: int = 0
    """Number of shocks that masters before this one measured with this mounting: each may have displaced the IMU."""

    def __post_init__(self) -> None:
        """Reject impossible parameters."""
        check_limits(
            self,
            latency_ns=(-(10**10), 10**10),
            gravity_mps2=(9.7, 9.9),
            tilt_sigma_rad=(0, 0.1),
            shocks_before=(0, 10**9),
        )
        check_coordinates("position_m", self.position_m)
        if not abs(math.hypot(*self.orientation_xyzw) - 1.0) < ROTATION_TOLERANCE:
            raise ValueError(f"orientation_xyzw holds {self.orientation_xyzw}, expected a unit quaternion")

    @property
    def mounting(self) -> tuple[Vector3, Row4]:
        """Position and orientation: what a knock changes, and a calibration determines anew."""
        return self.position_m, self.orientation_xyzw

    @property
    def point(self) -> ReferencePoint:
        """Its frame as a point of the robot whose pose may be exported."""
        return ReferencePoint(
            name=self.name, position_m=self.position_m, orientation_xyzw=self.orientation_xyzw
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryParameters(FiniteNumbers):
    """Parameters that put the wheel odometry of the robot beside the samples of its IMU; sigmas are one sigma."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    """Point of the robot whose speed the wheels tell, in the frame ``robot``, [x, y, z] in m: the centre of the axle that does not
    steer; of tracks, the middle between them."""
    orientation_xyzw: Row4 = (0.0, 0.0, 0.0, 1.0)
    """Rotation that takes coordinates in the axes of the wheels (x forwards, y to the left, z up) to the frame ``robot``, as
    a Hamilton unit quaternion [x, y, z, w]."""
    latency_ns: int = 0
    """From a sample to its stamp, in ns; subtracted from the stamp. Positive: the stamp is late."""
    speed_noise_mps: float = 0.01
    """White noise of the speed of a sample, in m/s."""
    scale_sigma: float = 0.02
    """Relative error of the speed that stays: load, tyres, a wrong radius."""
    slip_sigma: float = 0.03
    """Relative error of the speed that comes and goes."""
    slip_correlation_time_s: float = 5.0
    """How long slip lasts, in s."""
    direction_sigma_rad: float = 0.02
    """Of the direction in which the robot goes straight ahead, about the z axis of the wheels, in rad."""
    lateral_sigma_mps: float = 0.02
    """Of the mean velocity across the wheels over a second, in m/s."""
    vertical_sigma_mps: float = 0.03
    """Of the mean velocity of the point along the z axis of the wheels over a second, in m/s."""
    turning_sigma_m: float = 0.05
    """Of the distance between the point and the one that does not slide sideways in a turn, in m; times the yaw rate, a velocity."""

    def __post_init__(self) -> None:
        """Reject impossible parameters."""
        check_limits(
            self,
            latency_ns=(-(10**10), 10**10),
            speed_noise_mps=(1e-6, 10),
            scale_sigma=(1e-6, 0.5),
            slip_sigma=(1e-6, 0.5),
            slip_correlation_time_s=(0.1, 3600),
            direction_sigma_rad=(1e-6, 0.5),
            lateral_sigma_mps=(1e-6, 10),
            vertical_sigma_mps=(1e-6, 10),
            turning_sigma_m=(0, 10),
        )
        check_coordinates("position_m", self.position_m)
        if not abs(math.hypot(*self.orientation_xyzw) - 1.0) < ROTATION_TOLERANCE:
            raise ValueError(f"orientation_xyzw holds {self.orientation_xyzw}, expected a unit quaternion")
