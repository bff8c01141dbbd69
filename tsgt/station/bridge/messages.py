"""The JSON lines between a bridge program and the client, as docs/reference/bridge.md specifies them. Sans-I/O.

Lines of unknown type and unknown keys are ignored, so that the format can grow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from tsgt.model import MAX_INSTANT_NS, MAX_NUMBER, FiniteNumbers, Status
from tsgt.radio import Direction  # noqa: TC001 (pydantic resolves annotations at run time)
from tsgt.recording import Typed, decode

FORMAT_VERSION = 1  # changes when a client of the old version would misunderstand the new one

MAX_LINE_BYTES = 16_384  # longer lines are truncated; a measurement takes 300 bytes

MAX_DISTANCE_M = 20_000.0  # beyond the range of any total station: a larger number is in mm, or invalid

TimestampSource = Literal["host", "instrument", "arrival"]

Nanoseconds = Annotated[int, Field(ge=0, le=MAX_INSTANT_NS)]
Identifier = Annotated[int, Field(ge=0, le=MAX_NUMBER)]


@dataclass(frozen=True, slots=True, kw_only=True)
class HelloLine:
    """The program's first line: version of the format, identity of the instrument, source of timestamps, and commands.

    Attributes
    ----------
    stamps
        Source of the times of measurements: ``host_time_ns``, ``instrument_time_ns``, or the arrival of the line.
    clock
        Name of the instrument's clock, for the operator; empty where it has none.
    commands
        The commands that the program supports; unknown ones are ignored.
    """

    type: Literal["hello"] = "hello"
    bridge: int
    make: str
    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    stamps: TimestampSource
    clock: str = ""
    commands: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Measurement(FiniteNumbers):
    """Fields of both; angles 0 to 2 pi, distance positive, ``host_time_ns`` on CLOCK_MONOTONIC; null where unknown."""

    horizontal_angle_rad: float | None = None
    zenith_angle_rad: float | None = None
    slope_distance_m: float | None = None
    status: Status
    raw_status: Annotated[int, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)] = 0
    host_time_ns: Nanoseconds | None = None
    instrument_time_ns: Nanoseconds | None = None

    def __post_init__(self) -> None:
        """Reject impossible values with a message that names the unit."""
        for angle_rad in (self.horizontal_angle_rad, self.zenith_angle_rad):
            if angle_rad is not None and not 0 <= angle_rad <= 2 * math.pi:
                raise ValueError(f"an angle of {angle_rad:g}; expected 0 to 2 pi rad, or null")
        if self.slope_distance_m is not None and not 0 < self.slope_distance_m <= MAX_DISTANCE_M:
            raise ValueError(
                f"a distance of {self.slope_distance_m:g}; expected metres above 0, or null for none"
            )
        whole = None not in (self.horizontal_angle_rad, self.zenith_angle_rad, self.slope_distance_m)
        if self.status.usable and not whole:
            raise ValueError(f"status {self.status} without both angles and a distance")


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementLine(_Measurement):
    """A measurement of the tracked prism; ``prism`` null: that of the last executed ``track``."""

    type: Literal["measurement"] = "measurement"
    prism: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SingleMeasurementLine(_Measurement):
    """The response to ``measure``: a single measurement, with or without a target."""

    type: Literal["shot"] = "shot"
    id: Identifier


@dataclass(frozen=True, slots=True, kw_only=True)
class DoneLine:
    """The response to every other command, and to a failed ``measure``; ``error`` is empty when it was executed."""

    type: Literal["done"] = "done"
    id: Identifier
    error: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusLine:
    """The instrument's condition; see :class:`~tsgt.station.instrument.Condition`."""

    type: Literal["status"] = "status"
    activity: str = ""
    problem: str = ""
    battery_percent: Annotated[int, Field(ge=0, le=100)] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingsLine(FiniteNumbers):
    """The instrument's settings; see :class:`~tsgt.recording.journal.InstrumentRecord`."""

    type: Literal["settings"] = "settings"
    prism_type: str = ""
    prism_constant_m: float | None = None
    atmospheric_ppm: float | None = None
    temperature_c: float | None = None
    pressure_hpa: float | None = None
    distance_mode: str = ""
    angle_delay_ns: int = 0


ProgramLine = HelloLine | MeasurementLine | SingleMeasurementLine | DoneLine | StatusLine | SettingsLine

_KINDS: dict[str, type[ProgramLine]] = {
    "hello": HelloLine,
    "measurement": MeasurementLine,
    "shot": SingleMeasurementLine,
    "done": DoneLine,
    "status": StatusLine,
    "settings": SettingsLine,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackLine:
    """Track a prism, or search again, at ``towards``; null: where the telescope points, or the last direction."""

    type: Literal["track"] = "track"
    id: int
    prism: int
    towards: Direction | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectLine:
    """Stop tracking and prepare for single measurements of targets that the operator aims at."""

    type: Literal["direct"] = "direct"
    id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureLine:
    """Measure the target in the line of sight once."""

    type: Literal["measure"] = "measure"
    id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AtmosphereLine:
    """Set the atmospheric correction; see :class:`~tsgt.station.instrument.Atmosphere`."""

    type: Literal["atmosphere"] = "atmosphere"
    id: int
    temperature_c: float
    pressure_hpa: float


CommandLine = TrackLine | DirectLine | MeasureLine | AtmosphereLine


@dataclass(frozen=True, slots=True)
class _Versioned:
    bridge: int


@dataclass(frozen=True, slots=True)
class _Identified:
    id: int


class BridgeVersionError(ValueError):
    """The program uses another version of the format: none of its lines can be used."""


def decode_program_line(data: bytes) -> ProgramLine | None:
    """Decode a line of a program; None for an unknown type.

    Raises BridgeVersionError for the ``hello`` of another version, and ValueError (one line) if it is not JSON
    or a field is missing or invalid.
    """
    kind = decode(Typed, data).type
    if kind == "hello" and (version := decode(_Versioned, data).bridge) != FORMAT_VERSION:
        raise BridgeVersionError(
            f"prints version {version} of the bridge's line format; this client supports version {FORMAT_VERSION}: update the "
            "older of the two"
        )
    return decode(_KINDS[kind], data) if kind in _KINDS else None


def response_id(data: bytes) -> int | None:
    """Return the ``id`` of a response, even if its other fields are invalid; None for other lines."""
    try:
        is_response = decode(Typed, data).type in ("done", "shot")
        return decode(_Identified, data).id if is_response else None
    except ValueError:
        return None
