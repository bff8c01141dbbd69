"""Configuration of the robot's wheel odometry."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from tsgt.config.base import Model, Place, Positive
from tsgt.model import OdometryParameters, Row4

Ratio = Annotated[float, Field(gt=0, le=50)]
Speed = Annotated[float, Field(gt=0, le=10_000)]


class OdometryConfig(Model):
    """Wheel odometry of the robot, read by a program; it is used with the IMU."""

    command: Annotated[tuple[str, ...], Field(min_length=1)]
    """Program that reads the odometry, with its arguments; see the reference of its lines. An absolute path in the field."""
    position_m: Place = (0.0, 0.0, 0.0)
    """Point of the robot whose speed the wheels tell, in the robot frame, [x, y, z]: the centre of the axle that does not steer; of
    tracks, the middle between them."""
    orientation_xyzw: Row4 = (0.0, 0.0, 0.0, 1.0)
    """Unit quaternion [x, y, z, w] that rotates coordinates in the axes of the wheels (x forwards, z up) into the robot frame."""
    latency_ms: Annotated[float, Field(ge=-10_000, le=10_000)] = 0.0
    """Latency from a sample to its timestamp, subtracted from it. Positive: the timestamp is late."""
    speed_noise_mmps: Speed = 10.0
    """White noise of the speed of a sample."""
    scale_percent: Ratio = 2.0
    """One sigma of the speed's relative error that stays: load, tyres, a wrong radius."""
    slip_percent: Ratio = 3.0
    """One sigma of the speed's relative error that comes and goes."""
    slip_correlation_time_s: Annotated[float, Field(ge=0.1, le=3600)] = 5.0
    """How long slip lasts."""
    direction_deg: Annotated[float, Field(gt=0, le=25)] = 1.0
    """One sigma of the direction in which the robot goes straight ahead."""
    lateral_mmps: Speed = 20.0
    """One sigma of the mean velocity across the wheels over a second."""
    vertical_mmps: Speed = 30.0
    """One sigma of the mean velocity of the point along the z axis of the wheels over a second."""
    turning_mm: Annotated[float, Field(ge=0, le=10_000)] = 50.0
    """One sigma by which the point may be off the one that does not slide across in a turn."""
    stall_timeout_s: Positive = 2.0
    """The program is restarted if it prints no usable sample for this long."""

    def parameters(self) -> OdometryParameters:
        """Return the parameters in SI units. Raises ValueError if there are none such."""
        return OdometryParameters(
            position_m=self.position_m,
            orientation_xyzw=self.orientation_xyzw,
            latency_ns=round(self.latency_ms * 1e6),
            speed_noise_mps=self.speed_noise_mmps / 1e3,
            scale_sigma=self.scale_percent / 100,
            slip_sigma=self.slip_percent / 100,
            slip_correlation_time_s=self.slip_correlation_time_s,
            direction_sigma_rad=math.radians(self.direction_deg),
            lateral_sigma_mps=self.lateral_mmps / 1e3,
            vertical_sigma_mps=self.vertical_mmps / 1e3,
            turning_sigma_m=self.turning_mm / 1e3,
        )
