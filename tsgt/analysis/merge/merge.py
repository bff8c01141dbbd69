"""The stations' journals into the master's recording: what the radio did not carry, on the master's clock.

Appending is safe: each line is one write at the end of a file that nobody else may write, and what is there already
is not added again. So a merge that was killed is simply done once more.
"""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from tsgt.analysis.merge.matching import Boot, Run, better
from tsgt.analysis.merge.recording_index import RecordingIndex, identity, index_recording
from tsgt.errors import RecordingError
from tsgt.estimation import instrument_time_sigma_s
from tsgt.model import MAX_INSTANT_NS, PolarMeasurement
from tsgt.recording import MergedRecord, RecordingWriter, encode_line, read_lines, write_atomically
from tsgt.recording.journal import is_unfinished_journal, load_journal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from tsgt.analysis.merge.matching import Entry, Found
    from tsgt.analysis.merge.recording_index import Session
    from tsgt.analysis.merge.timing import MasterTime
    from tsgt.recording.journal import Journal

SESSION_MARGIN_NS = 120_000_000_000
"""What was measured longer before the master started, or after it ended, is no part of its run. Within two minutes it
may be: a master that fell over is back by then."""

MAX_TIME_BOUND_NS = 50_000_000
"""A measurement whose time is less certain is left out: at 1.5 m/s that is 75 mm, and a gap does less harm."""


@dataclass(slots=True)
class MergedJournal:
    """What came of one journal.

    Attributes
    ----------
    path
        Its file.
    station
        Whose it is.
    measurements
        How many it holds.
    added
        How many of them have been put into the recording.
    already_there
        How many came over the radio, or had been merged before.
    outside
        How many were made long before the recording or after it.
    untimed
        How many cannot be put on the master's clock, or not well enough.
    skipped
        Why the journal cannot be merged at all, one line; empty where it can.
    """

    path: Path
    station: int
    measurements: int
    added: int = 0
    already_there: int = 0
    outside: int = 0
    untimed: int = 0
    skipped: str = ""


@dataclass(frozen=True, slots=True)
class Merged:
    """What came of a merge.

    Attributes
    ----------
    journals
        One entry for each.
    bounds_ns
        What the times of the added measurements are within of the truth, in rising order.
    cut_bytes
        Length of a torn line at the end of the recording that had to go.
    """

    journals: tuple[MergedJournal, ...]
    bounds_ns: tuple[int, ...]
    cut_bytes: int = 0

    @property
    def added(self) -> int:
        """How many measurements have been put into the recording."""
        return sum(journal.added for journal in self.journals)

    @property
    def already_there(self) -> int:
        """How many were there before."""
        return sum(journal.already_there for journal in self.journals)


class _Addition(NamedTuple):
    """A line to be added; they go in by time."""

    stamp_ns: int
    place: int
    record: MergedRecord


def merge(
    recording: Path,
    journals: Sequence[Path],
    *,
    output: Path | None = None,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Merged:
    """Put into a recording what the journals have besides.

    Parameters
    ----------
    recording
        Of the master; lines are appended to it, if there is no ``output``.
    journals
        Of the stations, of any number of runs. All that a computer wrote since it was switched on help each other.
    output
        Gets the recording and what is added, and the recording stays as it is.
    keep_going
        Skip lines that cannot be read instead of raising.
    on_problem
        Told of every line that is skipped: a torn last line always, others with ``keep_going``; and of a journal that was
        only begun.

    Raises
    ------
    RecordingError
        A file cannot be read or is another one than it should be, none of the journals belongs to the recording, or
        another program is writing it.
    """
    paths = []
    for path in {path.resolve(): path for path in journals}.values():
        if not is_unfinished_journal(path):
            paths.append(path)
        elif on_problem is not None:
            on_problem(RecordingError("was only begun and holds nothing; it is passed over", path=path))
    loaded = [load_journal(path, keep_going=keep_going, on_problem=on_problem) for path in paths]
    if output is not None:
        recorded = index_recording(recording, keep_going=keep_going, on_problem=on_problem)
        merged, additions = _additions(recorded, recording, paths, loaded)
        with write_atomically(output) as file:
            for line in read_lines(recording, keep_going=keep_going):
                file.write(line.data + b"\n")
            for addition in additions:
                file.write(encode_line(addition.record) + b"\n")
        return merged
    next(read_lines(recording))  # what opens it for writing would make a new one of a name that is mistyped
    with RecordingWriter(recording) as writer:
        recorded = index_recording(recording, keep_going=keep_going, on_problem=on_problem)
        merged, additions = _additions(recorded, recording, paths, loaded)
        for addition in additions:
            writer.write(addition.record)
    return dataclasses.replace(merged, cut_bytes=writer.cut_bytes)


def _additions(
    recorded: RecordingIndex, recording: Path, paths: Sequence[Path], journals: Sequence[Journal]
) -> tuple[Merged, list[_Addition]]:
    """Find out what is to be added."""
    found = [
        MergedJournal(path, journal.station, len(journal.measurements))
        for path, journal in zip(paths, journals, strict=True)
    ]
    known: set[object] = set(recorded.merged)
    additions: list[_Addition] = []
    for boot in _boots(journals):
        compared = [(session, boot.against(session)) for session in recorded.sessions]
        why = _why_not(boot, recorded, compared)
        if why:
            for index in {run.number for run in boot.runs}:
                found[index].skipped = why
            continue
        for place, entry in enumerate(boot.entries):
            time = _sort(place, entry, compared, known, found[entry.run.number])
            if time is not None:
                record = _record(entry, time, paths[entry.run.number])
                additions.append(_Addition(time.unix_ns, len(additions), record))
    if found and all(each.skipped for each in found):
        raise RecordingError(
            f"none of the journals can be merged; {found[0].path}: {found[0].skipped}", path=recording
        )
    bounds_ns = sorted(addition.record.measurement.stamp_bound_ns or 0 for addition in additions)
    return Merged(tuple(found), tuple(bounds_ns)), sorted(additions)


def _boots(journals: Sequence[Journal]) -> Iterator[Boot]:
    """Put together what was written on one CLOCK_MONOTONIC; where that is not known, each journal stands alone."""
    boots: dict[object, list[Run]] = defaultdict(list)
    for index, journal in enumerate(journals):
        boots[journal.station, journal.head.boot or index].append(Run(index, journal))
    return map(Boot, boots.values())


def _why_not(boot: Boot, recorded: RecordingIndex, compared: Sequence[tuple[Session, Found]]) -> str:
    """Say why nothing can come of some journals; empty where something can, or they are empty."""
    station = boot.station
    if station not in recorded.stations:
        numbers = ", ".join(map(str, sorted(recorded.stations)))
        return f"is of station {station}, and the recording has only {numbers}"
    if not boot.entries or any(found.tied for _, found in compared):
        return ""
    delivered = any(found.delivered for _, found in compared)
    if boot.superframe:
        if not any(session.beacons for session, _ in compared):
            return "is of the protocol superframe, and the recording has no beacons"
        if not any(run.journal.receptions for run in boot.runs):
            return "does not say when beacons came: the station never joined, or stamps of the radios are not good to 100 us"
        if not any(found.heard for _, found in compared):
            return "knows no beacon of this recording; it is of another mission, or did not hear this master"
        return "none of its measurements is in the recording, which could tell how long a beacon takes to the station"
    if not any(session.clocks.get(station) for session, _ in compared):
        return f"is of the protocol classic, and the recording has no synchronisation with station {station}"
    if not delivered:
        return (
            "none of its measurements is in the recording: it is of another mission, or of a start of the computer "
            "that the radio has not seen"
        )
    return "the recording has no synchronisation with the station since this start of its computer"


def _sort(
    place: int,
    entry: Entry,
    compared: Sequence[tuple[Session, Found]],
    known: set[object],
    counts: MergedJournal,
) -> MasterTime | None:
    """Count a measurement; return its time if it is to be added."""
    key = identity(entry.measurement)
    times = [(session, found.times[place]) for session, found in compared]
    timed = [(session, time) for session, time in times if time is not None]
    if (
        key in known
        or any(place in found.delivered for _, found in compared)
        or (not timed and any(place in found.alike for _, found in compared))
    ):
        counts.already_there += 1
        return None
    best = None
    for session, time in timed:
        if session.start_ns - SESSION_MARGIN_NS <= time.unix_ns <= session.end_ns + SESSION_MARGIN_NS:
            best = better(best, time)
    if best is None and timed:
        counts.outside += 1
        return None
    if best is None or best.bound_ns > MAX_TIME_BOUND_NS or not 0 <= best.unix_ns <= MAX_INSTANT_NS:
        counts.untimed += 1
        return None
    counts.added += 1
    known.add(key)  # it may be there twice, in a copy of the journal
    return best


def _record(entry: Entry, time: MasterTime, path: Path) -> MergedRecord:
    # What is usual of instruments counts whenever poses are computed, of what was delivered as well.
    usual_ns = 1e9 * instrument_time_sigma_s(entry.measurement.sequence)
    beyond_ns = math.sqrt(max(entry.measurement.stamp_sigma_ns**2 - usual_ns**2, 0.0))
    measurement: PolarMeasurement = dataclasses.replace(
        entry.measurement,
        stamp_ns=time.unix_ns,
        stamp_sigma_ns=round(math.hypot(time.sigma_ns, beyond_ns)),
        stamp_bound_ns=time.bound_ns,
        received_ns=time.unix_ns,
    )
    return MergedRecord(journal=path.name, measurement=measurement)
