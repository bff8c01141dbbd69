"""The JSON lines of the program that reads the wheel odometry: those of an IMU's but for the samples. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from tsgt.imu.lines import MAX_SAMPLES_PER_LINE, DeviceHello, DeviceSamples, StatusLine, decode_device_line

ODOMETRY_FORMAT_VERSION = 1  # changes when a master of the old version would misunderstand the new one

MAX_SPEED_MPS = 50.0  # no ground robot is faster: a larger number has another unit

MAX_YAW_RATE_RADPS = 20.0

MAX_RATE_HZ = 1_000.0

Numbers = Annotated[tuple[float, ...], Field(max_length=MAX_SAMPLES_PER_LINE)] | None
Flags = Annotated[tuple[bool, ...], Field(max_length=MAX_SAMPLES_PER_LINE)] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryHelloLine(DeviceHello):
    """The program's first line; ``odometry`` is the version of the format."""

    odometry: int

    def __post_init__(self) -> None:
        """Reject a rate that no wheels have."""
        if self.rate_hz > MAX_RATE_HZ:
            raise ValueError(f"rate_hz is {self.rate_hz:g}, at most {MAX_RATE_HZ:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryLine(DeviceSamples):
    """Those of wheel odometry."""

    speed_mps: Numbers = None
    distance_m: Numbers = None
    yaw_rate_radps: Numbers = None
    valid: Flags = None

    def __post_init__(self) -> None:
        """Reject lines that leave time or motion open, and values that have another unit."""
        self._check_lists(self.speed_mps, self.distance_m, self.yaw_rate_radps, self.valid)
        if (self.speed_mps is None) == (self.distance_m is None):
            raise ValueError("expected either speed_mps or distance_m")
        for speed in self.speed_mps or ():
            check_speed(speed)
        for rate in self.yaw_rate_radps or ():
            if abs(rate) > MAX_YAW_RATE_RADPS:
                raise ValueError(f"a yaw rate of {rate:g}; expected rad/s, at most {MAX_YAW_RATE_RADPS:g}")


OdometryProgramLine = OdometryHelloLine | OdometryLine | StatusLine

_KINDS: dict[str, type[OdometryProgramLine]] = {
    "hello": OdometryHelloLine,
    "samples": OdometryLine,
    "status": StatusLine,
}


def decode_odometry_line(data: bytes) -> OdometryProgramLine | None:
    """Decode a line of an odometry program; see :func:`~tsgt.imu.lines.decode_device_line`."""
    return decode_device_line(data, _KINDS, "odometry", ODOMETRY_FORMAT_VERSION)


def check_speed(speed_mps: float) -> None:
    """Reject a speed that no robot has; the message names the unit."""
    if abs(speed_mps) > MAX_SPEED_MPS:
        raise ValueError(f"a speed of {speed_mps:g}; expected m/s, at most {MAX_SPEED_MPS:g}")
