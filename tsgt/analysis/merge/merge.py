"""Merges station journals into a master's recording: adds measurements that the radio did not deliver.

Appending is safe against interruption: each line is one write at the end of a file locked against other writers, and
measurements that are present are not added again. A merge that was killed is simply repeated.
"""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from tsgt.analysis.merge.matching import Boot, IndexedJournal, better
from tsgt.analysis.merge.recording_index import RecordingIndex, identity, index_recording
from tsgt.analysis.text_file import utf8_name
from tsgt.errors import RecordingError
from tsgt.estimation import instrument_time_sigma_s
from tsgt.model import MAX_INSTANT_NS, PolarMeasurement
from tsgt.recording import MergedRecord, RecordingWriter, encode_line, read_lines, write_atomically
from tsgt.recording.journal import is_unfinished_journal, load_journal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.merge.matching import JournalMeasurement, Match
    from tsgt.analysis.merge.recording_index import Session
    from tsgt.analysis.merge.timing import MasterTime
    from tsgt.recording.journal import Journal

SESSION_MARGIN_NS = 120_000_000_000  # Before the start or after the end; a crashed master restarts sooner
MAX_TIME_BOUND_NS = 50_000_000  # At 1.5 m/s that is 75 mm; a gap does less harm


@dataclass(slots=True)
class MergedJournal:
    """Number of measurements of one journal, by result.

    Attributes
    ----------
    already_there : Delivered over the radio, or merged before.
    outside : Made long before or after the recording.
    untimed : Without a time on the master's clock, or with too large a bound.
    skipped : Why the journal cannot be merged at all, one line; empty if it can.
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
    """Result of a merge: the journals, increasing time bounds of the added measurements, bytes of an incomplete line removed."""

    journals: tuple[MergedJournal, ...]
    bounds_ns: tuple[int, ...]
    cut_bytes: int = 0

    @property
    def added(self) -> int:
        """Number of measurements written to the recording."""
        return sum(journal.added for journal in self.journals)

    @property
    def already_there(self) -> int:
        """Number of measurements that the recording already had."""
        return sum(journal.already_there for journal in self.journals)


class _Addition(NamedTuple):
    """A line to be added, in the order of time."""

    stamp_ns: int
    position: int
    record: MergedRecord


def merge(
    recording: Path,
    journals: Sequence[Path],
    *,
    output: Path | None = None,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Merged:
    """Add the measurements of journals that a recording lacks.

    Parameters
    ----------
    recording : Of the master; lines are appended to it unless ``output`` is given.
    journals : Of the stations, of any number of runs; journals of the same boot share clock samples.
    output : Receives the recording and the additions; the recording remains unchanged.
    keep_going : Skip unreadable lines instead of raising.
    on_problem
        Called with every skipped line: an incomplete last line always, others with ``keep_going``; and with a journal that
        has no content yet.

    Raises
    ------
    RecordingError
        A file cannot be read or is of another type, none of the journals belongs to the recording, or another program is
        writing it.
    """
    paths = []
    for path in {path.resolve(): path for path in journals}.values():
        if not is_unfinished_journal(path):
            paths.append(path)
        elif on_problem is not None:
            on_problem(RecordingError("is empty; skipped", path=path))
    loaded = [load_journal(path, keep_going=keep_going, on_problem=on_problem) for path in paths]
    if output is not None:
        recorded = index_recording(recording, keep_going=keep_going, on_problem=on_problem)
        merged, additions = _additions(recorded, recording, paths, loaded)
        with write_atomically(output) as file:
            for line in read_lines(recording, imu=True, keep_going=keep_going):
                file.write(line.data + b"\n")
            for addition in additions:
                file.write(encode_line(addition.record) + b"\n")
        return merged
    next(read_lines(recording))  # opening for writing would create a file with a mistyped name
    with RecordingWriter(recording) as writer:
        recorded = index_recording(recording, keep_going=keep_going, on_problem=on_problem)
        merged, additions = _additions(recorded, recording, paths, loaded)
        for addition in additions:
            writer.write(addition.record)
    return dataclasses.replace(merged, cut_bytes=writer.cut_bytes)


def _additions(
    recorded: RecordingIndex, recording: Path, paths: Sequence[Path], journals: Sequence[Journal]
) -> tuple[Merged, list[_Addition]]:
    """Collect the lines to be added."""
    results = [
        MergedJournal(path, journal.station, len(journal.measurements))
        for path, journal in zip(paths, journals, strict=True)
    ]
    known: set[object] = set(recorded.merged)
    additions: list[_Addition] = []
    for boot in _boots(journals):
        matches = [(session, boot.against(session)) for session in recorded.sessions]
        reason = _rejection_reason(boot, recorded, matches)
        if reason:
            for index in {source.number for source in boot.journals}:
                results[index].skipped = reason
            continue
        for index, entry in enumerate(boot.entries):
            time = _classify(index, entry, matches, known, results[entry.source.number])
            if time is not None:
                record = _record(entry, time, paths[entry.source.number], recorded.stations)
                additions.append(_Addition(time.unix_ns, len(additions), record))
    if results and all(result.skipped for result in results):
        raise RecordingError(
            f"none of the journals can be merged; {results[0].path}: {results[0].skipped}", path=recording
        )
    bounds_ns = sorted(addition.record.measurement.stamp_bound_ns or 0 for addition in additions)
    return Merged(tuple(results), tuple(bounds_ns)), sorted(additions)


def _boots(journals: Sequence[Journal]) -> Iterator[Boot]:
    """Group journals by boot; a journal with an unknown boot is a group of its own."""
    boots: dict[object, list[IndexedJournal]] = defaultdict(list)
    for index, journal in enumerate(journals):
        boots[journal.station, journal.head.boot or index].append(IndexedJournal(index, journal))
    return map(Boot, boots.values())


def _rejection_reason(boot: Boot, recorded: RecordingIndex, matches: Sequence[tuple[Session, Match]]) -> str:
    """Return why the journals of a boot cannot be merged; empty if they can, or have no measurements."""
    station = boot.station
    if station not in recorded.stations:
        numbers = ", ".join(map(str, sorted(recorded.stations)))
        return f"is of station {station}, but the recording has only {numbers}"
    if not boot.entries or any(match.clock_related for _, match in matches):
        return ""
    delivered = any(match.delivered for _, match in matches)
    if boot.superframe:
        if not any(session.beacons for session, _ in matches):
            return "is of the protocol superframe, but the recording has no beacons"
        if not any(source.journal.receptions for source in boot.journals):
            return "has no beacon times: the station never joined, or its radio timestamps are less accurate than 100 us"
        if not any(match.beacons_received for _, match in matches):
            return "has no beacon of this recording: it is of another mission, or did not receive this master"
        return "none of its measurements is in the recording, so the link delay is unknown"
    if not any(session.clocks.get(station) for session, _ in matches):
        return f"is of the protocol classic, but the recording has no synchronisation with station {station}"
    if not delivered:
        return (
            "none of its measurements is in the recording: it is of another mission, or of a boot of the computer "
            "without radio contact"
        )
    return "the recording has no synchronisation with the station since this boot of its computer"


def _classify(
    index: int,
    entry: JournalMeasurement,
    matches: Sequence[tuple[Session, Match]],
    known: set[object],
    counts: MergedJournal,
) -> MasterTime | None:
    """Count a measurement; return its time if it is to be added."""
    key = identity(entry.measurement)
    times = [(session, match.times[index]) for session, match in matches]
    timed = [(session, time) for session, time in times if time is not None]
    if (
        key in known
        or any(index in match.delivered for _, match in matches)
        or (not timed and any(index in match.same_content for _, match in matches))
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
    known.add(key)  # a journal may be given twice
    return best


def _record(
    entry: JournalMeasurement, time: MasterTime, path: Path, prisms: Mapping[int, int]
) -> MergedRecord:
    """``prisms``: of the stations, which classic does not transmit: what was delivered has the one that the master's configuration names."""
    classic = entry.source.journal.head.stream_id is None
    # Processing adds the instrument's usual time sigma to every measurement: record only the excess.
    usual_ns = 1e9 * instrument_time_sigma_s(entry.measurement.sequence)
    excess_ns = math.sqrt(max(entry.measurement.stamp_sigma_ns**2 - usual_ns**2, 0.0))
    measurement: PolarMeasurement = dataclasses.replace(
        entry.measurement,
        prism=prisms[entry.measurement.station] if classic else entry.measurement.prism,
        stamp_ns=time.unix_ns,
        stamp_sigma_ns=round(math.hypot(time.sigma_ns, excess_ns)),
        stamp_bound_ns=time.bound_ns,
        received_ns=time.unix_ns,
    )
    return MergedRecord(journal=utf8_name(path.name), measurement=measurement)
