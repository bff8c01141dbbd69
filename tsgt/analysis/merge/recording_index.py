"""What a master's recording knows that helps to merge journals into it: who was heard, and when."""

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
    """One run of the master; its times are on one Unix timeline, those of another run may be on another.

    Attributes
    ----------
    start_ns, end_ns
        From the header to the last line that has a time.
    clocks
        Synchronisations by station, in their order.
    beacons
        By number of the session on the air, and in it by that of the frame.
    delivered
        What came over the radio, by station.
    """

    start_ns: int
    end_ns: int
    clocks: dict[int, list[ClockRecord]] = field(default_factory=lambda: defaultdict(list))
    beacons: dict[int, dict[int, BeaconRecord]] = field(default_factory=lambda: defaultdict(dict))
    delivered: dict[int, list[PolarMeasurement]] = field(default_factory=lambda: defaultdict(list))


@dataclass(slots=True)
class RecordingIndex:
    """A recording as far as merging needs it.

    Attributes
    ----------
    stations
        Numbers of those that any parameters name.
    sessions
        In their order.
    merged
        What has been merged into it before.
    """

    stations: set[int] = field(default_factory=set)
    sessions: list[Session] = field(default_factory=list)
    merged: set[Identity] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class _Stamped:
    stamp_ns: int


def identity(measurement: PolarMeasurement) -> Identity | None:
    """Return what no two measurements share; None where the station's own time did not come over the radio.

    The time alone is not enough: a computer without a battery clock may live through the same hour each day.
    """
    if measurement.host_time_ns is None:
        return None
    return (
        measurement.station,
        measurement.host_time_ns,
        measurement.horizontal_angle_rad,
        measurement.zenith_angle_rad,
        measurement.slope_distance_m or None,  # over classic 0 stands for none
    )


def index_recording(
    path: Path, *, keep_going: bool = False, on_problem: Callable[[RecordingError], None] | None = None
) -> RecordingIndex:
    """Read a recording.

    Parameters
    ----------
    path, keep_going, on_problem
        See :func:`~tsgt.recording.load_recording`.

    Raises
    ------
    RecordingError
        As :func:`~tsgt.recording.load_recording`; also for a file that no master has written.
    """
    recorded = RecordingIndex()
    for line in read_lines(path, keep_going=keep_going, on_problem=on_problem):
        if line.type == "journal":
            raise RecordingError("is a station's journal; give the master's recording first", path=path)
        try:
            _take(line, recorded, path)
        except CorruptLineError as problem:
            if not keep_going:
                raise
            if on_problem is not None:
                on_problem(problem)
    if not recorded.stations:
        raise RecordingError("holds no parameters; the program that wrote it ended too early", path=path)
    if not any(session.clocks or session.beacons for session in recorded.sessions):
        raise RecordingError(
            "holds neither synchronisations nor beacons, so nothing ties the stations' clocks to it; "
            "give the recording as the master wrote it",
            path=path,
        )
    return recorded


def _take(line: Line, recorded: RecordingIndex, path: Path) -> None:
    if line.type == "recording":
        start_ns = decode_line(RecordingHeader, line, path).created_ns
        recorded.sessions.append(Session(start_ns, start_ns))
    session = recorded.sessions[-1]  # the first line is a header
    known_ns = session.end_ns
    match line.type:
        case "parameters":
            recorded.stations |= {s.station for s in decode_line(Parameters, line, path).stations}
        case "measurement":
            measurement = decode_line(PolarMeasurement, line, path)
            session.delivered[measurement.station].append(measurement)
            known_ns = measurement.received_ns
        case "merged":
            key = identity(decode_line(MergedRecord, line, path).measurement)
            if key is not None:
                recorded.merged.add(key)
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
