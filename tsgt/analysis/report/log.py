"""Radio quality, station clocks and events of a recording, for its report."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from tsgt.errors import RecordingError
from tsgt.recording import ImuStatus, OdometryStatus

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

_S = TypeVar("_S", ImuStatus, OdometryStatus)

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


def read_log(path: Path) -> Log:
    """Read status, clock and event records, for illustration only; unreadable lines are skipped.

    Raises RecordingError if the file cannot be read.
    """
    statuses: list[dict[str, Any]] = []
    clocks: dict[int, list[dict[str, Any]]] = defaultdict(list)
    events: list[tuple[int, str]] = []
    try:
        with path.open("rb") as file:
            for raw in file:
                # Poses are most of a file: parsing them would take longer than everything else.
                if raw.startswith(_SKIPPED_PREFIXES) or not any(kind in raw for kind in _TYPES):
                    continue
                record = _parsed(raw)
                match record.get("type"):
                    case "status":
                        statuses.append(record)
                    case "clock":
                        clocks[record["station"]].append(record)
                    case "event":
                        events.append((record["stamp_ns"], str(record.get("message", ""))))
    except OSError as error:
        raise RecordingError(f"cannot be read ({error.strerror})", path=path) from error
    last = statuses[-1] if statuses else {}
    return Log(
        radio=_radio(statuses),
        clocks={station: _clock(records) for station, records in sorted(clocks.items())},
        events=tuple(events),
        protocol=last.get("protocol"),
        authenticated=last.get("authenticated"),
        imu=_device(ImuStatus, last.get("imu")),
        odometry=_device(OdometryStatus, last.get("odometry")),
    )


def _parsed(raw: bytes) -> dict[str, Any]:
    try:
        record = json.loads(raw)
    except ValueError:
        return {}
    return record if isinstance(record, dict) and isinstance(record.get("stamp_ns"), int) else {}


def _device(cls: type[_S], status: object) -> _S | None:
    try:
        return None if status is None else TypeAdapter(cls).validate_python(status)
    except ValidationError:
        return None


def _radio(statuses: list[dict[str, Any]]) -> dict[int, RadioSeries]:
    rows: dict[int, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    for status in statuses:
        for station in status.get("stations", ()):
            rows[station["id"]].append((status["stamp_ns"], station))
    return {
        number: RadioSeries(
            np.array([stamp_ns for stamp_ns, _ in found], dtype=np.int64),
            *(
                np.array([np.nan if s.get(key) is None else s[key] for _, s in found], dtype=np.float64)
                for key in ("rssi_dbm", "snr_db", "loss")
            ),
        )
        for number, found in sorted(rows.items())
    }


def _clock(records: list[dict[str, Any]]) -> ClockSeries:
    stamp_ns, offset_ns, bound_ns = (
        np.array([r[key] for r in records], dtype=np.int64) for key in ("stamp_ns", "offset_ns", "bound_ns")
    )
    return ClockSeries(
        stamp_ns, offset_ns, bound_ns, np.array([r["restarted"] for r in records], dtype=np.bool_)
    )
