"""Part of a scenario: the robot's IMU, and the shaking that it measures."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from tsgt.config.base import Model, Place

ImuModelName = Literal["none", "industrial", "consumer"]

_UNIT_TOLERANCE = 1e-4  # of a quaternion with four digits; its user normalises it


class ShakingConfig(Model):
    """Fast shaking while the robot drives, part of the ground truth: band-limited noise, isotropic, flat in the band."""

    when: Literal["with_imu", "always", "never"] = "with_imu"
    """Whether the robot is shaken only if it has an IMU, always, or never."""
    acceleration_rms_mps2: Annotated[float, Field(ge=0, le=100)] = 1.5
    """Acceleration at the IMU along each axis, root mean square at speeds from 0.5 m/s on."""
    angular_rate_rms_radps: Annotated[float, Field(ge=0, le=10)] = 0.06
    """Angular rate about each axis, root mean square at speeds from 0.5 m/s on."""
    low_hz: Annotated[float, Field(ge=1, le=200)] = 8.0
    """Lower limit of the band."""
    high_hz: Annotated[float, Field(ge=1, le=200)] = 60.0
    """Upper limit of the band."""

    @model_validator(mode="after")
    def _consistent(self) -> ShakingConfig:
        if self.low_hz + 1.0 > self.high_hz:
            raise ValueError("low_hz is less than 1 Hz below high_hz")
        return self


class ImuSetupErrorConfig(Model):
    """Errors of the set-up of the IMU: in the configuration of the master, or in the program that reads the IMU."""

    rotation_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Rotation of the mounting in the configuration of the master, about the IMU's [1, 1, 1] axis."""
    position_mm: Annotated[float, Field(ge=-10_000, le=10_000)] = 0.0
    """Displacement of the IMU in the configuration of the master, along the robot's x axis."""
    latency_ms: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """Error of the latency in the configuration of the master."""
    axes_swapped: bool = False
    """Whether the program swaps the x and y axes and inverts z."""
    degrees: bool = False
    """Whether the program gives angular rates in degrees per second."""
    gravity_inverted: bool = False
    """Whether the program gives accelerations with gravity pointing down: the specific force with the wrong sign."""


class SimulatedImu(Model):
    """The robot's IMU and where it is."""

    model: ImuModelName = "none"
    """Class of the IMU; none: the robot has none."""
    serial_number: Annotated[int, Field(ge=0, le=10**9)] = 5
    """Selects scale factors, misalignment, sensitivities and clock of the device; the same in all missions, whatever the seed."""
    position_m: Place = (0.21, -0.12, 0.43)
    """Origin of its axes in the robot frame."""
    orientation_xyzw: tuple[float, float, float, float] = (0.00897, -0.01569, 0.71731, 0.69652)
    """Rotation from its axes to the robot frame, a unit quaternion to four digits."""
    latency_ms: Annotated[float, Field(ge=0, le=1000)] = 4.3
    """From the end of a sample's interval to its earliest arrival: filter, transmission and host together."""
    latitude_deg: Annotated[float, Field(ge=-90, le=90)] = 46.8
    """Latitude of station 1, for gravity and the Earth's rotation."""
    height_m: Annotated[float, Field(ge=-500, le=9000)] = 100.0
    """Height of station 1 above the ellipsoid."""
    vertical_sigma_arcsec: Annotated[float, Field(ge=0, le=3600)] = 3.0
    """Angle between the z axis of station 1 and the vertical, one sigma per axis: its compensator."""
    setup_error: ImuSetupErrorConfig = ImuSetupErrorConfig()
    """Errors of the set-up; none by default."""

    @field_validator("orientation_xyzw")
    @classmethod
    def _unit(cls, value: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        norm = math.hypot(*value)
        if abs(norm - 1.0) > _UNIT_TOLERANCE:
            raise ValueError(f"orientation_xyzw is no unit quaternion: its norm is {norm:.6g}")
        return value
