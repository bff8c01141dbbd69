"""What a bridge program and the client say to each other: JSON lines, as docs/reference/bridge.md specifies them.

Lines of a type that is not known here are passed over, and so are keys, so that the format can grow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from tsgt.model import LARGEST_NUMBER, LAST_INSTANT_NS, Status
from tsgt.radio import Direction  # noqa: TC001 (pydantic looks it up when the program runs)
from tsgt.recording import Typed, decode

FORMAT_VERSION = 1
"""Of the lines. It changes when a client of the old one would misunderstand the new one."""

MAX_LINE_BYTES = 16_384
"""What is kept of a line; a measurement takes three hundred."""

MAX_TEXT = 200
"""What is kept of a text for people."""

FARTHEST_M = 20_000.0
"""No total station measures so far: such a number is in mm, or none."""

Stamps = Literal["host", "instrument", "arrival"]

Nanoseconds = Annotated[int, Field(ge=0, le=LAST_INSTANT_NS)]
Identifier = Annotated[int, Field(ge=0, le=LARGEST_NUMBER)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """The program's first line: what it speaks and which instrument it has.

    Attributes
    ----------
    bridge
        Version of the format, :data:`FORMAT_VERSION`.
    make, model, serial_number, firmware
        Of the instrument; empty where unknown.
    stamps
        Where the times of measurements come from: ``host_time_ns``, ``instrument_time_ns``, or the arrival of the line.
    clock
        Name of the instrument's clock, for people; empty where it has none.
    commands
        What the program can be told; those that are not known here do no harm.
    """

    type: Literal["hello"] = "hello"
    bridge: int
    make: str
    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    stamps: Stamps
    clock: str = ""
    commands: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Measured:
    """What both kinds of measurements have; see :class:`~tsgt.station.instrument.Reading`.

    Attributes
    ----------
    horizontal_angle_rad, zenith_angle_rad
        0 to 2 pi; null where there are none.
    slope_distance_m
        Above 0; null where there is none.
    status, raw_status
        The verdict, in the common vocabulary and as the instrument's own number.
    host_time_ns
        When it was taken, on CLOCK_MONOTONIC; null where the program does not know.
    instrument_time_ns
        The same on the instrument's clock.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    horizontal_angle_rad: float | None = None
    zenith_angle_rad: float | None = None
    slope_distance_m: float | None = None
    status: Status
    raw_status: Annotated[int, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)] = 0
    host_time_ns: Nanoseconds | None = None
    instrument_time_ns: Nanoseconds | None = None

    def __post_init__(self) -> None:
        """Refuse what no instrument can have measured, and say which unit is meant."""
        for angle_rad in (self.horizontal_angle_rad, self.zenith_angle_rad):
            if angle_rad is not None and not 0 <= angle_rad <= 2 * math.pi:
                raise ValueError(f"an angle of {angle_rad:g}; expected 0 to 2 pi rad, or null")
        if self.slope_distance_m is not None and not 0 < self.slope_distance_m <= FARTHEST_M:
            raise ValueError(
                f"a distance of {self.slope_distance_m:g}; expected metres above 0, or null for none"
            )
        whole = None not in (self.horizontal_angle_rad, self.zenith_angle_rad, self.slope_distance_m)
        if self.status.usable and not whole:
            raise ValueError(f"status {self.status} without both angles and a distance")


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementLine(_Measured):
    """A measurement of the tracked prism.

    Attributes
    ----------
    prism
        Which one; null: that of the last ``track`` that was done.
    """

    type: Literal["measurement"] = "measurement"
    prism: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ShotLine(_Measured):
    """The answer to ``measure``: a single measurement, also one that found no target."""

    type: Literal["shot"] = "shot"
    id: Identifier


@dataclass(frozen=True, slots=True, kw_only=True)
class DoneLine:
    """The answer to every other command, and to a ``measure`` that came to nothing.

    Attributes
    ----------
    error
        Why it was not done, for people; empty when it was.
    """

    type: Literal["done"] = "done"
    id: Identifier
    error: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusLine:
    """How the instrument does; see :class:`~tsgt.station.instrument.Condition`."""

    type: Literal["status"] = "status"
    activity: str = ""
    problem: str = ""
    battery_percent: Annotated[int, Field(ge=0, le=100)] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingsLine:
    """How the instrument is set; see :class:`~tsgt.recording.journal.InstrumentRecord`."""

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["settings"] = "settings"
    prism_type: str = ""
    prism_constant_m: float | None = None
    atmospheric_ppm: float | None = None
    temperature_c: float | None = None
    pressure_hpa: float | None = None
    distance_mode: str = ""
    angle_delay_ns: int = 0


ProgramLine = Hello | MeasurementLine | ShotLine | DoneLine | StatusLine | SettingsLine

_KINDS: dict[str, type[ProgramLine]] = {
    "hello": Hello,
    "measurement": MeasurementLine,
    "shot": ShotLine,
    "done": DoneLine,
    "status": StatusLine,
    "settings": SettingsLine,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackCommand:
    """Track a prism from now on; the one that is tracked already: look for it anew.

    Attributes
    ----------
    towards
        Where it is believed to be; null: where the telescope points, or where it was last.
    """

    type: Literal["track"] = "track"
    id: int
    prism: int
    towards: Direction | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectCommand:
    """Stop tracking and get ready for single measurements of targets that a person aims at."""

    type: Literal["direct"] = "direct"
    id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureCommand:
    """Measure the target that the instrument points at, once."""

    type: Literal["measure"] = "measure"
    id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AtmosphereCommand:
    """Correct distances for this air from now on; see :class:`~tsgt.station.instrument.Atmosphere`."""

    type: Literal["atmosphere"] = "atmosphere"
    id: int
    temperature_c: float
    pressure_hpa: float


Command = TrackCommand | DirectCommand | MeasureCommand | AtmosphereCommand


@dataclass(frozen=True, slots=True)
class _Versioned:
    bridge: int


@dataclass(frozen=True, slots=True)
class _Addressed:
    id: int


class BridgeVersionError(ValueError):
    """The program speaks another version of the format: nothing that it says can be used."""


def decode_program_line(data: bytes) -> ProgramLine | None:
    """Read a line of a program; None for one of a type that is not known here.

    Raises
    ------
    BridgeVersionError
        It is the ``hello`` of another version.
    ValueError
        In one line: it is not JSON, or the first field that is missing or wrong.
    """
    kind = decode(Typed, data).type
    if kind == "hello" and (version := decode(_Versioned, data).bridge) != FORMAT_VERSION:
        raise BridgeVersionError(
            f"speaks version {version} of the bridge's lines, and this client version {FORMAT_VERSION}"
        )
    return decode(_KINDS[kind], data) if kind in _KINDS else None


def command_answered(data: bytes) -> int | None:
    """Return the ``id`` of the command that a line answers, even if the rest of it cannot be used; None for others."""
    try:
        answers = decode(Typed, data).type in ("done", "shot")
        return decode(_Addressed, data).id if answers else None
    except ValueError:
        return None


def for_people(text: str) -> str:
    """Return a text from outside as one line that does no harm to a terminal, cut where it is very long."""
    return "".join(sign if sign.isprintable() else " " for sign in text[:MAX_TEXT]).strip()


class LineCutter:
    """Cuts what a program prints into lines; of one that never ends only the beginning is kept.

    Parameters
    ----------
    limit_bytes
        So much of a line is kept. What is cut off is no JSON any more, and refused as that.
    """

    def __init__(self, limit_bytes: int = MAX_LINE_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._begun = b""

    def push(self, data: bytes) -> list[bytes]:
        """Take more bytes, return the lines that are whole now, without their ends and without empty ones."""
        first, *others = data.split(b"\n")
        lines = [self._begun + first[: self._limit_bytes - len(self._begun)]]
        lines += [line[: self._limit_bytes] for line in others]
        self._begun = lines.pop()
        return [line for line in lines if line.strip()]
