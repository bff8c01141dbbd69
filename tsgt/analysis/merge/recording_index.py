"""Index of a master's recording for merging: what was delivered, synchronisations and beacons."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.model import Parameters, PolarMeasurement
from tsgt.recording import BeaconRecord, ClockRecord, MergedRecord, RecordingHeader, decode_line, read_lines

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.recording import Line

Identity = tuple[int, int, float, float, float | None]


@dataclass(slots=True)
class Session:
    """One session of the master, from the header to the last line with a time. Another session may have another Unix timeline.

    ``clocks`` and ``delivered`` are synchronisations and received measurements by station, ``beacons`` are by session number in
    the protocol, then by frame counter.
    """

    start_ns: int
    end_ns: int
    clocks: dict[int, list[ClockRecord]] = field(default_factory=lambda: defaultdict(list))
    beacons: dict[int, dict[int, BeaconRecord]] = field(default_factory=lambda: defaultdict(dict))
    delivered: dict[int, list[PolarMeasurement]] = field(default_factory=lambda: defaultdict(list))


@dataclass(slots=True)
class RecordingIndex:
    """Prisms of all stations in the parameters, sessions of the master, and identities of measurements merged before.

    ``stations``: prism by the number of the station, of the last parameters that have it.
    """

    stations: dict[int, int] = field(default_factory=dict)
    sessions: list[Session] = field(default_factory=list)
    merged: set[Identity] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class _Stamped:
    stamp_ns: int


def identity(measurement: PolarMeasurement) -> Identity | None:
    """Return what identifies a measurement: not the time alone, which a computer without a battery-backed clock may repeat.

    None if the station's own time was not transmitted.
    """
    if measurement.host_time_ns is None:
        return None
    return (
        measurement.station,
        measurement.host_time_ns,
        measurement.horizontal_angle_rad,
        measurement.zenith_angle_rad,
        measurement.slope_distance_m or None,  # classic transmits 0 for none
    )


def index_recording(
    path: Path, *, keep_going: bool = False, on_problem: Callable[[RecordingError], None] | None = None
) -> RecordingIndex:
    """Read a recording as :func:`~tsgt.recording.load_recording` does. Raises RecordingError also if no master wrote it."""
    index = RecordingIndex()
    for line in read_lines(path, keep_going=keep_going, on_problem=on_problem):
        if line.type == "journal":
            raise RecordingError("is a station's journal; give the master's recording first", path=path)
        try:
            _add(line, index, path)
        except CorruptLineError as problem:
            if not keep_going:
                raise
            if on_problem is not None:
                on_problem(problem)
    if not index.stations:
        raise RecordingError("contains no parameters; the program that wrote it ended too early", path=path)
    if not any(session.clocks or session.beacons for session in index.sessions):
        raise RecordingError(
            "contains neither synchronisations nor beacons, so the stations' clocks cannot be related to it; "
            "give the recording as the master wrote it",
            path=path,
        )
    return index


def _add(line: Line, index: RecordingIndex, path: Path) -> None:
    if line.type == "recording":
        start_ns = decode_line(RecordingHeader, line, path).created_ns
        index.sessions.append(Session(start_ns, start_ns))
    session = index.sessions[-1]  # the first line is a header
    known_ns = session.end_ns
    match line.type:
        case "parameters":
            index.stations |= {s.station: s.prism for s in decode_line(Parameters, line, path).stations}
        case "measurement":
            measurement = decode_line(PolarMeasurement, line, path)
            session.delivered[measurement.station].append(measurement)
            known_ns = measurement.received_ns
        case "merged":
            key = identity(decode_line(MergedRecord, line, path).measurement)
            if key is not None:
                index.merged.add(key)
        case "clock":
            clock = decode_line(ClockRecord, line, path)
            session.clocks[clock.station].append(clock)
            known_ns = clock.stamp_ns
        case "beacon":
            beacon = decode_line(BeaconRecord, line, path)
            session.beacons[beacon.session][beacon.counter] = beacon
            known_ns = beacon.stamp_ns
        case "status" | "event":
            known_ns = decode_line(_Stamped, line, path).stamp_ns
    session.end_ns = max(session.end_ns, known_ns)
