"""The messages of the paper's protocol, byte for byte as the authors' field nodes send them.

Commands of the master are ASCII: a letter, the digit of the station, and for ``n`` optionally the digit of a prism.
Numbers in replies are little-endian and unpadded. docs/reference/radio-protocol.md specifies every byte, with examples.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Literal, cast, get_args

from tsgt.model import Status, check_finite

Letter = Literal["t", "p", "e", "s", "c", "d", "n"]
"""t: data, p: begin synchronisation, e: ping, s: timestamp of the ping, c: end it, d: direct mode, n: track."""

STATIONS = PRISMS = range(1, 10)  # one ASCII digit, without 0

COMMAND_BYTES = 2
PING_REPLY_BYTES = 2
TIME_REPLY_BYTES = 9
MEASUREMENT_BYTES = 34

MAX_TIME_NS = 2**32 * 1_000_000_000 - 1  # in February 2106

_TIME = struct.Struct("<cII")
_MEASUREMENT = struct.Struct("<BBdddII")
_ACKNOWLEDGEMENTS = (b"dOk", b"dNo", b"nOk", b"nNo")

OK, TILT, WRONG_DISTANCE, OTHER, NO_DISTANCE = range(5)
_STATUS = {
    OK: Status.OK,
    TILT: Status.TILT,
    WRONG_DISTANCE: Status.WRONG_DISTANCE,
    OTHER: Status.NO_TARGET,
    NO_DISTANCE: Status.ANGLE_ONLY,
}
_RAW_STATUS = {
    Status.OK: OK,
    Status.LOW_ACCURACY: OK,
    Status.ANGLE_ONLY: NO_DISTANCE,
    Status.NO_TARGET: OTHER,
    Status.TILT: TILT,
    Status.WRONG_DISTANCE: WRONG_DISTANCE,
    Status.ERROR: OTHER,
}

# Limits of a total station's values, to reject unknown packets of 34 bytes.
_MAX_ANGLE_RAD = 4 * math.pi
_MAX_DISTANCE_M = 20_000.0
# An authors' node without a measurement converts -1.0 to uint32: 0 on ARM, all ones on x86.
_NO_SECONDS = (0, 0xFFFF_FFFF)


@dataclass(frozen=True, slots=True)
class CommandMessage:
    """A command of the master; ``n`` may name the prism to track. Raises ValueError if there is no such command."""

    letter: Letter
    station: int
    prism: int | None = None

    def __post_init__(self) -> None:
        if self.letter not in get_args(Letter):
            raise ValueError(f"there is no command {self.letter!r}")
        _check_station(self.station)
        if self.prism is not None and (self.letter != "n" or self.prism not in PRISMS):
            raise ValueError(f"only n takes a prism, and only 1 to 9, got {self.letter} with {self.prism}")

    def to_bytes(self) -> bytes:
        """Encode in two bytes, or three with a prism."""
        return f"{self.letter}{self.station}{'' if self.prism is None else self.prism}".encode("ascii")


@dataclass(frozen=True, slots=True)
class PingReply:
    """The station has received ``e`` and timestamped it; the same two bytes as the command."""

    station: int

    def __post_init__(self) -> None:
        _check_station(self.station)

    def to_bytes(self) -> bytes:
        """Encode in two bytes."""
        return f"e{self.station}".encode("ascii")


@dataclass(frozen=True, slots=True)
class TimeReply:
    """Reception of the last ``e`` on the station's Unix clock, or 0. It names neither the station nor the ``e``."""

    time_ns: int

    def __post_init__(self) -> None:
        _check_time(self.time_ns)

    def to_bytes(self) -> bytes:
        """Encode in nine bytes."""
        return _TIME.pack(b"s", *divmod(self.time_ns, 1_000_000_000))


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """The reply to ``d`` and ``n``: whether the command was executed. It does not name the station."""

    letter: Literal["d", "n"]
    ok: bool

    def to_bytes(self) -> bytes:
        """Encode in three bytes."""
        return f"{self.letter}{'Ok' if self.ok else 'No'}".encode("ascii")


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementMessage:
    """The reply to ``t``.

    Raises ValueError if a number is out of range or not finite.

    Attributes
    ----------
    station
        A binary number, not a digit.
    status
        0 good, 1 tilted, 2 wrong distance, 3 no target or another error, 4 no distance or one below 1 m.
    zenith_angle_rad, horizontal_angle_rad
        As in :class:`~tsgt.model.PolarMeasurement`; the authors call the first one elevation.
    slope_distance_m
        Without prism constant; 0 with status 4.
    time_ns
        On the station's Unix clock. 0: no measurement yet, or an error of an authors' node.
    """

    station: int
    status: int
    zenith_angle_rad: float
    horizontal_angle_rad: float
    slope_distance_m: float
    time_ns: int

    def __post_init__(self) -> None:
        _check_station(self.station)
        if self.status not in _STATUS:
            raise ValueError(f"the status is {self.status}, expected 0 to 4")
        check_finite(self.zenith_angle_rad, self.horizontal_angle_rad, self.slope_distance_m)
        _check_time(self.time_ns)

    def to_bytes(self) -> bytes:
        """Encode in 34 bytes."""
        return _MEASUREMENT.pack(
            self.station,
            self.status,
            self.zenith_angle_rad,
            self.horizontal_angle_rad,
            self.slope_distance_m,
            *divmod(self.time_ns, 1_000_000_000),
        )


Reply = PingReply | TimeReply | Acknowledgement | MeasurementMessage


def no_measurement_yet(station: int) -> MeasurementMessage:
    """Return the reply before the first measurement: zeros, but unlike the authors' nodes not with a good status."""
    return MeasurementMessage(
        station=station,
        status=OTHER,
        zenith_angle_rad=0.0,
        horizontal_angle_rad=0.0,
        slope_distance_m=0.0,
        time_ns=0,
    )


def status_of(message: MeasurementMessage) -> Status:
    """Return the common status; a good status without time or distance is rejected."""
    if message.status == OK and message.time_ns == 0:
        return Status.NO_TARGET
    if message.status == OK and message.slope_distance_m == 0:
        return Status.ANGLE_ONLY
    return _STATUS[message.status]


def raw_status(status: Status) -> int:
    """Return the protocol's number of a status: seven are mapped to five."""
    return _RAW_STATUS[status]


def decode_command(payload: bytes) -> CommandMessage | None:
    """Decode a command; None for any other packet."""
    try:
        text = payload.decode("ascii")
    except UnicodeDecodeError:
        return None
    if len(text) not in (COMMAND_BYTES, COMMAND_BYTES + 1) or not text[1:].isdecimal():
        return None
    prism = int(text[2]) if len(text) > COMMAND_BYTES else None
    try:
        return CommandMessage(cast("Letter", text[0]), int(text[1]), prism)
    except ValueError:
        return None


def decode_reply(payload: bytes) -> Reply | None:
    """Decode a reply; None for any other packet, also for one with impossible values."""
    try:
        match len(payload):
            case 2 if payload[:1] == b"e" and payload[1:].isdigit():
                return PingReply(int(payload[1:]))
            case 3 if payload in _ACKNOWLEDGEMENTS:
                return Acknowledgement("d" if payload[:1] == b"d" else "n", payload[1:] == b"Ok")
            case 9 if payload[:1] == b"s":
                time_ns = _time_ns(*_TIME.unpack(payload)[1:])
                return None if time_ns is None else TimeReply(time_ns)
            case 34:
                return _decode_measurement(payload)
    except ValueError:
        pass
    return None


def _decode_measurement(payload: bytes) -> MeasurementMessage | None:
    station, status, zenith_rad, horizontal_rad, distance_m, seconds, nanoseconds = _MEASUREMENT.unpack(
        payload
    )
    time_ns = _time_ns(seconds, nanoseconds)
    if status in (OK, NO_DISTANCE):
        angles_possible = max(abs(zenith_rad), abs(horizontal_rad)) <= _MAX_ANGLE_RAD
        if time_ns is None or not angles_possible or not 0 <= distance_m <= _MAX_DISTANCE_M:
            return None
    elif time_ns is None or seconds in _NO_SECONDS:
        time_ns = 0
    return MeasurementMessage(
        station=station,
        status=status,
        zenith_angle_rad=zenith_rad,
        horizontal_angle_rad=horizontal_rad,
        slope_distance_m=distance_m,
        time_ns=time_ns,
    )


def _time_ns(seconds: int, nanoseconds: int) -> int | None:
    return seconds * 1_000_000_000 + nanoseconds if nanoseconds < 1_000_000_000 else None


def _check_station(station: int) -> None:
    if station not in STATIONS:
        raise ValueError(f"the station is {station}, expected 1 to 9")


def _check_time(time_ns: int) -> None:
    if not 0 <= time_ns <= MAX_TIME_NS:
        raise ValueError(f"a time of {time_ns} ns does not fit into 32 bits of seconds")
