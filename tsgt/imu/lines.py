"""The JSON lines of the program that reads the IMU, as docs/reference/imu-program.md specifies them. Sans-I/O.

Lines of unknown type and unknown keys are ignored, so that the format can grow.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

from pydantic import Field

from tsgt.model import MAX_INSTANT_NS, FiniteNumbers, Vector3
from tsgt.recording import Typed, decode

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Line = TypeVar("Line")
Device = Literal["imu", "odometry"]

FORMAT_VERSION = 1  # changes when a master of the old version would misunderstand the new one

MAX_LINE_BYTES = 65_536  # longer lines are truncated; ten samples take 1.5 kB

MAX_SAMPLES_PER_LINE = 256

MAX_ANGULAR_RATE_RADPS = 100.0  # no IMU measures 6000 deg/s: a larger number has another unit

MAX_SPECIFIC_FORCE_MPS2 = 2_000.0  # 200 g

_MIN_RATE_HZ, _MAX_RATE_HZ = 1.0, 5_000.0

Count = Annotated[int, Field(ge=0, le=MAX_INSTANT_NS)]
Counts = Annotated[tuple[Count, ...], Field(max_length=MAX_SAMPLES_PER_LINE)] | None
Vectors = Annotated[tuple[Vector3, ...], Field(max_length=MAX_SAMPLES_PER_LINE)] | None
Limit = Annotated[float, Field(gt=0, le=1e6)] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceHello(FiniteNumbers):
    """First line of a program that reads a device: identity of the device, rate of its samples.

    Attributes
    ----------
    rate_hz
        Nominal rate of the samples.
    clock
        Name of the device's clock or counter, for people.
    """

    type: Literal["hello"] = "hello"
    make: str
    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    rate_hz: Annotated[float, Field(ge=_MIN_RATE_HZ, le=_MAX_RATE_HZ)]
    clock: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class HelloLine(DeviceHello):
    """That of an IMU; ``imu`` is the version of the format.

    Attributes
    ----------
    angular_rate_limit_radps, specific_force_limit_mps2
        Full scale of each axis; null where unknown.
    """

    imu: int
    angular_rate_limit_radps: Limit = None
    specific_force_limit_mps2: Limit = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceSamples(FiniteNumbers):
    """Consecutive samples of any device: lists with one entry per sample."""

    type: Literal["samples"] = "samples"
    counter: Counts = None
    instrument_time_ns: Counts = None
    host_time_ns: Counts = None

    def __len__(self) -> int:
        return len(self.counter or self.instrument_time_ns or ())

    def _check_lists(self, *values: Sequence[object] | None) -> None:
        """Reject samples without time, and lists of different lengths; ``values``: the lists of what was measured."""
        if self.counter is None and self.instrument_time_ns is None:
            raise ValueError("neither counter nor instrument_time_ns, without which samples have no time")
        lists = (self.counter, self.instrument_time_ns, self.host_time_ns, *values)
        lengths = {len(each) for each in lists if each is not None}
        if len(lengths) > 1 or 0 in lengths:
            raise ValueError("the lists have different lengths, or none has an entry")


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplesLine(DeviceSamples):
    """Those of an IMU."""

    angular_rate_radps: Vectors = None
    delta_angle_rad: Vectors = None
    specific_force_mps2: Vectors = None
    delta_velocity_mps: Vectors = None

    def __post_init__(self) -> None:
        """Reject lines that leave time or motion open, and values that have another unit."""
        self._check_lists(
            self.angular_rate_radps, self.delta_angle_rad, self.specific_force_mps2, self.delta_velocity_mps
        )
        if (self.angular_rate_radps is None) == (self.delta_angle_rad is None):
            raise ValueError("expected either angular_rate_radps or delta_angle_rad")
        if (self.specific_force_mps2 is None) == (self.delta_velocity_mps is None):
            raise ValueError("expected either specific_force_mps2 or delta_velocity_mps")
        if self.angular_rate_radps is not None:
            check_angular_rate(self.angular_rate_radps)
        if self.specific_force_mps2 is not None:
            check_specific_force(self.specific_force_mps2)


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusLine:
    """What the program does, and what the operator should correct."""

    type: Literal["status"] = "status"
    activity: str = ""
    problem: str = ""


ProgramLine = HelloLine | SamplesLine | StatusLine

_KINDS: dict[str, type[ProgramLine]] = {"hello": HelloLine, "samples": SamplesLine, "status": StatusLine}


class FormatVersionError(ValueError):
    """The program uses another version of the format: none of its lines can be used."""


@dataclass(frozen=True, slots=True)
class _Versioned:
    imu: int | None = None
    odometry: int | None = None


def decode_device_line(
    data: bytes, kinds: Mapping[str, type[Line]], device: Device, version: int
) -> Line | None:
    """Decode a line of a program that reads a device; None for an unknown type.

    Raises FormatVersionError for the ``hello`` of another version, and ValueError (one line) if it is not JSON or a field
    is missing or invalid.
    """
    kind = decode(Typed, data).type
    if kind == "hello" and (found := getattr(decode(_Versioned, data), device)) not in (None, version):
        name = {"imu": "an IMU", "odometry": "odometry"}[device]
        raise FormatVersionError(
            f"prints version {found} of the line format of {name}; this master supports version {version}: update the older "
            "of the two"
        )
    return decode(kinds[kind], data) if kind in kinds else None


def decode_program_line(data: bytes) -> ProgramLine | None:
    """Decode a line of an IMU's program; see :func:`decode_device_line`."""
    return decode_device_line(data, _KINDS, "imu", FORMAT_VERSION)


def check_angular_rate(rates_radps: Sequence[Vector3]) -> None:
    """Reject angular rates that no device measures; the message names the unit."""
    largest = max(map(abs, chain.from_iterable(rates_radps)))
    if largest > MAX_ANGULAR_RATE_RADPS:
        raise ValueError(
            f"an angular rate of {largest:g}; expected rad/s, at most {MAX_ANGULAR_RATE_RADPS:g}"
        )


def check_specific_force(forces_mps2: Sequence[Vector3]) -> None:
    """Reject specific forces that no device measures; the message names the unit."""
    largest = max(map(abs, chain.from_iterable(forces_mps2)))
    if largest > MAX_SPECIFIC_FORCE_MPS2:
        raise ValueError(
            f"a specific force of {largest:g}; expected m/s^2, at most {MAX_SPECIFIC_FORCE_MPS2:g}"
        )
