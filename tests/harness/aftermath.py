"""What daemons that were killed have left behind: files that are whole, and everything in them, once and as measured.

The checks look at files alone, and know of the daemons' ends only that they were sudden. Those that simulated runs are
checked with are used where they fit.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path  # noqa: TC003 (a dataclass looks it up)
from statistics import median_low
from typing import TYPE_CHECKING

from tsgt.errors import RecordingError
from tsgt.model import PolarMeasurement
from tsgt.radio.superframe.wire import RESTART_SKIP
from tsgt.recording import Typed, decode, load_recording
from tsgt.recording.journal import load_journal
from tsgt.simulation.checks import Violation
from tsgt.simulation.checks.invariants import journal_mismatches, timestamp_violations, duplicate_deliveries, reading_mismatches
from tsgt.simulation.mission import JournalIndex, MasterLog, StationLog

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from tsgt.recording.journal import Journal
    from tsgt.simulation.instrument import ReportedDistance

_HEAD_LINES = 2
"""A file that ends within these, the header and whose it is, holds nothing else."""


@dataclass(slots=True)
class Found:
    """What there was, and what was wrong with it.

    Attributes
    ----------
    violations
        All that must not be.
    counts
        For people: files, lines, measurements and the like.
    """

    violations: list[Violation]
    counts: Counter[str]


def aftermath(
    recordings: Sequence[Path],
    journals: Mapping[int, Path],
    reported_distances: Mapping[int, Sequence[ReportedDistance]],
    queued: Mapping[int, int],
) -> Found:
    """Check what masters and clients of one computer have left, over the protocol superframe.

    Parameters
    ----------
    recordings
        Of the masters.
    journals
        By station: the folder of its clients' journals.
    offered
        By station: every distance that its instrument has answered with.
    queued
        By station: how many measurements were in its queue at the end.
    """
    found = Found([], Counter())
    begun = {path for path in recordings if not _whole(path, "recordings", found)}
    master_logs = [_session(path) for path in sorted(set(recordings) - begun)]
    recorded = {(m.station, m.sequence) for session in master_logs for m in session.measurements}
    found.counts["measurements recorded"] = len(recorded)
    for session in master_logs:
        found.counts["recorded again by a later master"] += len(session.measurements)
        found.violations += duplicate_deliveries(session)
    found.counts["recorded again by a later master"] -= len(recorded)
    stations: dict[int, JournalIndex] = {}
    for station, folder in journals.items():
        kept = [path for path in sorted(folder.glob("*.jsonl")) if _whole(path, "journals", found)]
        runs = sorted((load_journal(path) for path in kept), key=lambda journal: journal.head.first_sequence)
        found.violations += reused(station, runs)
        # One computer has one CLOCK_MONOTONIC.
        stamps_ns = {
            m.stamp_ns: m.stamp_ns - journal.head.unix_at_zero_ns
            for journal in runs
            for m in journal.measurements
        }
        station_log = _Kept(station, folder, reported_distances[station], stamps_ns, kept=kept)
        measured = stations[station] = JournalIndex(station_log)
        found.counts["measurements journalled"] += len(measured.journalled)
        found.violations += reading_mismatches(station_log, measured)
        found.violations += journal_mismatches(station_log, measured, master_logs)
        missing = sorted(m.sequence for m in measured.journalled if (station, m.sequence) not in recorded)
        found.counts["still in a queue"] += len(missing)
        if len(missing) > queued[station]:
            found.violations.append(
                Violation(
                    "lost",
                    f"station {station}: {len(missing)} measurements are journalled, in no recording, and only "
                    f"{queued[station]} were in its queue; the first is number {missing[0]}",
                )
            )
    for session in master_logs:
        found.violations += _mistimed(session, stations)
    return found


def _mistimed(session: MasterLog, stations: Mapping[int, JournalIndex]) -> Iterator[Violation]:
    """Compare the times of a recording with those of the journals, but for the master's Unix time at the start."""
    apart_ns = [
        m.stamp_ns - true_ns
        for m in session.measurements
        if (true_ns := stations[m.station].true_ns(m)) is not None
    ]
    if apart_ns:
        yield from timestamp_violations(session, stations, start_ns=median_low(apart_ns))


def reused(station: int, runs: Sequence[Journal]) -> Iterator[Violation]:
    """Look for sequence numbers that a station has left out within a run or given again in a later one.

    Parameters
    ----------
    station
        Its number.
    runs
        Its journals, by their first number.
    """
    stream_ids = {journal.head.stream_id for journal in runs}
    if len(stream_ids) > 1:
        yield Violation(
            "number", f"station {station} has begun to number anew: stream_ids {sorted(map(str, stream_ids))}"
        )
    for journal in runs:
        numbers = [m.sequence for m in journal.measurements]
        first = journal.head.first_sequence
        if numbers != list(range(first, first + len(numbers))):
            yield Violation(
                "number", f"station {station}, run from {first}: numbers do not run on: {numbers[:20]} ..."
            )
    for before, after in pairwise(runs):
        last = max((m.sequence for m in before.measurements), default=before.head.first_sequence - 1)
        if after.head.first_sequence <= last + RESTART_SKIP:
            yield Violation(
                "number",
                f"station {station} has begun a run at {after.head.first_sequence}, after {last} was given in the one before",
            )


@dataclass(slots=True)
class _Kept(StationLog):
    """Of a folder only the journals that have a head."""

    kept: list[Path] = field(default_factory=list)

    @property
    def journals(self) -> list[Path]:
        """Those, one for each time that the client got so far."""
        return self.kept


def _session(path: Path) -> MasterLog:
    session = MasterLog(path.parent, lambda: 0, 0)
    session.measurements += [m for m in load_recording(path).measurements if isinstance(m, PolarMeasurement)]
    return session


def _whole(path: Path, kind: str, found: Found) -> bool:
    """Read each line; return whether the file has got as far as its second one."""
    *lines, tail = path.read_bytes().split(b"\n")
    found.counts[kind] += 1
    found.counts[f"lines of {kind}"] += len(lines)
    found.counts[f"torn tails of {kind}"] += bool(tail)
    for number, line in enumerate(lines, start=1):
        try:
            decode(Typed, line)
        except ValueError as error:
            found.violations.append(Violation("torn", f"{path}, line {number} of {len(lines)}: {error}"))
            return False
    if len(lines) < _HEAD_LINES:
        found.counts[f"{kind} without a head"] += 1
        return False
    try:  # with the reader of the desk, which must pass over the tail
        problems: list[RecordingError] = []
        (load_journal if kind == "journals" else load_recording)(path, on_problem=problems.append)
    except RecordingError as error:
        found.violations.append(Violation("torn", str(error)))
        return False
    if len(problems) != bool(tail):
        found.violations.append(Violation("torn", f"{path}: {len(problems)} lines passed over"))
    return True
