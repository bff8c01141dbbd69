"""What the estimators assume, and when a pose is valid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from tsgt.model.values import FiniteNumbers, Vector3, check_limits


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionPrior(FiniteNumbers):
    """Motion prior of the estimator ``continuous``: acceleration as an Ornstein-Uhlenbeck process."""

    acceleration_sigma_mps2: Vector3 = (0.4, 0.4, 0.2)
    """One sigma of the acceleration of the prisms' centroid along x, y, z of frame ``station1``."""
    acceleration_correlation_time_s: float = 0.8
    """Time in s after which the acceleration's correlation has fallen to 1/e."""
    angular_acceleration_sigma_radps2: Vector3 = (0.15, 0.15, 0.2)
    """One sigma of the angular acceleration about x, y, z of the robot."""
    angular_acceleration_correlation_time_s: float = 0.4
    """The same time for the angular acceleration."""

    def __post_init__(self) -> None:
        """Reject motion that no robot has."""
        check_limits(
            self,
            acceleration_correlation_time_s=(1e-3, 1e4),
            angular_acceleration_correlation_time_s=(1e-3, 1e4),
        )
        for sigma in (*self.acceleration_sigma_mps2, *self.angular_acceleration_sigma_radps2):
            if not 1e-6 <= sigma <= 1e6:
                raise ValueError(f"a sigma of an acceleration is {sigma}, expected 1e-06 to 1e+06")


@dataclass(frozen=True, slots=True, kw_only=True)
class PipelineParameters(FiniteNumbers):
    """Parameters of the estimators."""

    estimator: Literal["linear", "continuous"] = "continuous"
    """Name of the estimator: ``linear`` (straight lines between measurements) or ``continuous`` (one smooth trajectory
    through all of them)."""
    period_ns: int = 50_000_000
    """Interval of the pose epochs in ns; epochs are the whole multiples of it in Unix time."""
    outage_limit_ns: int = 1_000_000_000
    """A longer interval between two measurements of a prism, in ns, is an outage: no valid poses with `linear`, degraded ones with
    `continuous` while their sigmas are within the limits."""
    transport_limit_ns: int = 2_000_000_000
    """A measurement that has not arrived this long after it was made, in ns, is not waited for. For `linear`."""
    residual_limit_m: float = 0.05
    """A pose whose prisms miss the layout by more than this (root mean square over the prisms) is invalid."""
    tilt_limit_rad: float = math.pi / 2
    """A pose whose robot z axis leans further than this from vertical is invalid: the prism layout is mirrored, or two
    stations have swapped prisms."""
    acceleration_sigma_mps2: float = 0.3
    """One sigma, per axis, of the robot's acceleration between two measurements: the error of linear interpolation,
    which the covariance includes. For ``linear``."""
    angular_acceleration_sigma_radps2: float = 0.15
    """The same for its angular acceleration. For ``linear``."""
    motion: MotionPrior = MotionPrior()
    """Motion prior. For ``continuous``."""
    noise_scale: float = 1.0
    """Factor on the noise of all instruments. For ``continuous``."""
    lag_ns: int = 3_000_000_000
    """Lag of the smoothed poses in ns; measurements that arrive later after they were made are not used. For
    ``continuous``."""
    smoothed_delays_ns: tuple[int, ...] = ()
    """Delays in ns at which smoothed poses are computed before the lag, each at the first epoch at which it has passed.
    For ``continuous``; none in recordings of older versions."""
    position_sigma_limit_m: float = 0.05
    """A smoothed pose whose position (of the reference point, in its least certain direction) has a sigma above this is
    invalid. For ``continuous``."""
    rotation_sigma_limit_rad: float = math.radians(2.0)
    """The same for the sigma of its rotation. For ``continuous``."""
    predicted_position_sigma_limit_m: float = 0.15
    """As ``position_sigma_limit_m``, at the reference point, for predicted poses."""
    predicted_rotation_sigma_limit_rad: float = math.radians(5.0)
    """The same for the sigma of their rotation."""

    def __post_init__(self) -> None:
        """Reject limits that nothing can be computed with."""
        check_limits(
            self,
            period_ns=(1_000_000, 1e12),
            outage_limit_ns=(0, 1e15),
            transport_limit_ns=(0, 1e15),
            residual_limit_m=(0, 1e6),
            tilt_limit_rad=(0, math.pi),
            acceleration_sigma_mps2=(0, 1e6),
            angular_acceleration_sigma_radps2=(0, 1e6),
            noise_scale=(1e-3, 1e3),
            lag_ns=(0, 60_000_000_000),
            position_sigma_limit_m=(0, 1e6),
            rotation_sigma_limit_rad=(0, math.pi),
            predicted_position_sigma_limit_m=(0, 1e6),
            predicted_rotation_sigma_limit_rad=(0, math.pi),
        )
        for delay_ns in self.smoothed_delays_ns:
            if not 0 < delay_ns < self.lag_ns:
                raise ValueError(
                    f"smoothed_delays_ns: {delay_ns} is not between 0 and lag_ns ({self.lag_ns})"
                )
