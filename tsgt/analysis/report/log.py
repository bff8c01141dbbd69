"""Radio quality, station clocks and events of a recording, for its report."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from tsgt.errors import RecordingError
from tsgt.recording import ImuStatus, OdometryStatus

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

_T = TypeVar("_T")

_TYPES = (b'"status"', b'"clock"', b'"event"')

_SKIPPED_PREFIXES = (b'{"type":"pose"', b'{"type":"measurement"', b'{"type":"point"', b'{"type":"beacon"')
"""Prefixes of most lines: skipped without parsing."""


@dataclass(frozen=True, slots=True)
class RadioSeries:
    """Radio quality of a station at N status records, on the master's Unix clock; NaN where nothing was recorded.

    ``rssi_dbm`` and ``snr_db``, (N,), are of its last radio message, ``loss``, (N,), is the share of its last requests without
    a response, 0 to 1.
    """

    stamp_ns: NDArray[np.int64]
    rssi_dbm: FloatArray
    snr_db: FloatArray
    loss: FloatArray


@dataclass(frozen=True, slots=True)
class ClockSeries:
    """A station's clock relative to the master's at N synchronisations, on the master's Unix clock.

    ``offset_ns``, (N,), is positive if the station is ahead, ``bound_ns`` the bound of its error; ``restarted``: filter reset.
    """

    stamp_ns: NDArray[np.int64]
    offset_ns: NDArray[np.int64]
    bound_ns: NDArray[np.int64]
    restarted: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Log:
    """Records of a recording other than measurements and poses.

    ``radio`` and ``clocks`` are by station, ``events`` are (stamp_ns, message) in the order of the file, ``protocol`` and
    ``authenticated`` are those of the last status (None without a radio), as are ``imu`` and ``odometry`` (None without).
    """

    radio: dict[int, RadioSeries]
    clocks: dict[int, ClockSeries]
    events: tuple[tuple[int, str], ...]
    protocol: str | None
    authenticated: bool | None
    imu: ImuStatus | None = None
    odometry: OdometryStatus | None = None


_Integer = Annotated[int, Field(ge=-(2**63), lt=2**63)]


@dataclass(frozen=True, slots=True)
class _Station:
    id: _Integer
    rssi_dbm: float | None = None
    snr_db: float | None = None
    loss: float | None = None


@dataclass(frozen=True, slots=True)
class _Status:
    stamp_ns: _Integer
    stations: tuple[_Station, ...] = ()
    protocol: str | None = None
    authenticated: bool | None = None
    imu: Any = None
    odometry: Any = None


@dataclass(frozen=True, slots=True)
class _Clock:
    stamp_ns: _Integer
    station: _Integer
    offset_ns: _Integer
    bound_ns: _Integer
    restarted: bool


@dataclass(frozen=True, slots=True)
class _Event:
    stamp_ns: _Integer
    message: str = ""


_adapter: Callable[[object], TypeAdapter[Any]] = cache(TypeAdapter)


def read_log(path: Path) -> Log:
    """Read status, clock and event records, for illustration only; lines that cannot be used are skipped.

    Raises RecordingError if the file cannot be read.
    """
    statuses: list[_Status] = []
    clocks: dict[int, list[_Clock]] = defaultdict(list)
    events: list[tuple[int, str]] = []
    try:
        with path.open("rb") as file:
            for raw in file:
                # Poses are most of a file: parsing them would take longer than everything else.
                if raw.startswith(_SKIPPED_PREFIXES) or not any(kind in raw for kind in _TYPES):
                    continue
                match _parsed(raw):
                    case _Status() as status:
                        statuses.append(status)
                    case _Clock() as clock:
                        clocks[clock.station].append(clock)
                    case _Event(stamp_ns, message):
                        events.append((stamp_ns, message))
    except OSError as error:
        raise RecordingError(f"cannot be read ({error.strerror})", path=path) from error
    last = statuses[-1] if statuses else _Status(0)
    return Log(
        radio=_radio(statuses),
        clocks={station: _clock(records) for station, records in sorted(clocks.items())},
        events=tuple(events),
        protocol=last.protocol,
        authenticated=last.authenticated,
        imu=_valid(ImuStatus, last.imu),
        odometry=_valid(OdometryStatus, last.odometry),
    )


def _parsed(raw: bytes) -> _Status | _Clock | _Event | None:
    try:
        record = json.loads(raw)
    except ValueError:
        return None
    match record:
        case {"type": "status"}:
            return _valid(_Status, record)
        case {"type": "clock"}:
            return _valid(_Clock, record)
        case {"type": "event"}:
            return _valid(_Event, record)
    return None


def _valid(cls: type[_T], value: object) -> _T | None:
    """Return the record; None without one, or if a field is missing or wrong."""
    try:
        return None if value is None else _adapter(cls).validate_python(value)
    except ValidationError:
        return None


def _radio(statuses: list[_Status]) -> dict[int, RadioSeries]:
    rows: dict[int, list[tuple[int, _Station]]] = defaultdict(list)
    for status in statuses:
        for station in status.stations:
            rows[station.id].append((status.stamp_ns, station))
    return {
        number: RadioSeries(
            np.array([stamp_ns for stamp_ns, _ in found], dtype=np.int64),
            # None becomes NaN.
            *(
                np.array([getattr(station, key) for _, station in found], dtype=np.float64)
                for key in ("rssi_dbm", "snr_db", "loss")
            ),
        )
        for number, found in sorted(rows.items())
    }


def _clock(records: list[_Clock]) -> ClockSeries:
    return ClockSeries(
        np.array([record.stamp_ns for record in records], dtype=np.int64),
        np.array([record.offset_ns for record in records], dtype=np.int64),
        np.array([record.bound_ns for record in records], dtype=np.int64),
        np.array([record.restarted for record in records], dtype=np.bool_),
    )
