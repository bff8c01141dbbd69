"""Invariants of the files left by killed daemons: intact lines, and each measurement once, as measured.

Only files are checked. Invariants of simulated missions are reused where they apply.
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
from tsgt.simulation.checks.invariants import (
    duplicate_deliveries,
    journal_mismatches,
    reading_mismatches,
    timestamp_violations,
)
from tsgt.simulation.mission import JournalIndex, MasterLog, StationLog

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from tsgt.recording.journal import Journal
    from tsgt.simulation.instrument import ReportedDistance

_HEAD_LINES = 2
"""Header and first record; a file without both has no content."""


@dataclass(slots=True)
class FileReport:
    """Result of the checks."""

    violations: list[Violation]
    counts: Counter[str]


def check_files_after_kills(
    recordings: Sequence[Path],
    journals: Mapping[int, Path],
    reported_distances: Mapping[int, Sequence[ReportedDistance]],
    queued: Mapping[int, int],
) -> FileReport:
    """Check the files of masters and clients on one computer, over protocol superframe.

    Parameters
    ----------
    journals
        Journal folder by station.
    reported_distances
        All distances that each instrument reported.
    queued
        Final queue length by station.
    """
    report = FileReport([], Counter())
    incomplete = {path for path in recordings if not _is_intact(path, "recordings", report)}
    master_logs = [_log_of(path) for path in sorted(set(recordings) - incomplete)]
    recorded = {(m.station, m.sequence) for master_log in master_logs for m in master_log.measurements}
    report.counts["measurements recorded"] = len(recorded)
    for master_log in master_logs:
        report.counts["recorded by two masters"] += len(master_log.measurements)
        report.violations += duplicate_deliveries(master_log)
    report.counts["recorded by two masters"] -= len(recorded)
    indices: dict[int, JournalIndex] = {}
    for station, folder in journals.items():
        intact = [path for path in sorted(folder.glob("*.jsonl")) if _is_intact(path, "journals", report)]
        journals_by_start = sorted(
            (load_journal(path) for path in intact), key=lambda journal: journal.head.first_sequence
        )
        report.violations += sequence_violations(station, journals_by_start)
        # All daemons share one CLOCK_MONOTONIC.
        stamps_ns = {
            m.stamp_ns: m.stamp_ns - journal.head.unix_at_zero_ns
            for journal in journals_by_start
            for m in journal.measurements
        }
        station_log = _StationLogFiles(station, folder, reported_distances[station], stamps_ns, intact=intact)
        journal_index = indices[station] = JournalIndex(station_log)
        report.counts["measurements journalled"] += len(journal_index.journalled)
        report.violations += reading_mismatches(station_log, journal_index)
        report.violations += journal_mismatches(station_log, journal_index, master_logs)
        missing = sorted(
            m.sequence for m in journal_index.journalled if (station, m.sequence) not in recorded
        )
        report.counts["queued"] += len(missing)
        if len(missing) > queued[station]:
            report.violations.append(
                Violation(
                    "lost",
                    f"station {station}: {len(missing)} journalled measurements are in no recording, "
                    f"{queued[station]} are in its queue; first sequence number {missing[0]}",
                )
            )
    for master_log in master_logs:
        report.violations += _timestamp_violations(master_log, indices)
    return report


def _timestamp_violations(master_log: MasterLog, indices: Mapping[int, JournalIndex]) -> Iterator[Violation]:
    """Compare timestamps of a recording and the journals, up to the offset of the master's Unix clock."""
    differences_ns = [
        m.stamp_ns - true_ns
        for m in master_log.measurements
        if (true_ns := indices[m.station].true_ns(m)) is not None
    ]
    if differences_ns:
        yield from timestamp_violations(master_log, indices, start_ns=median_low(differences_ns))


def sequence_violations(station: int, journals_by_start: Sequence[Journal]) -> Iterator[Violation]:
    """Find sequence numbers that a station has skipped within a journal or reused in a later one.

    ``journals_by_start`` are its journals sorted by their first sequence number.
    """
    stream_ids = {journal.head.stream_id for journal in journals_by_start}
    if len(stream_ids) > 1:
        yield Violation(
            "number",
            f"station {station}: {len(stream_ids)} stream ids, expected one: {sorted(map(str, stream_ids))}",
        )
    for journal in journals_by_start:
        numbers = [m.sequence for m in journal.measurements]
        first = journal.head.first_sequence
        if numbers != list(range(first, first + len(numbers))):
            yield Violation(
                "number", f"station {station}: journal from {first} has gaps or repeats: {numbers[:20]} ..."
            )
    for before, after in pairwise(journals_by_start):
        last = max((m.sequence for m in before.measurements), default=before.head.first_sequence - 1)
        if after.head.first_sequence <= last + RESTART_SKIP:
            yield Violation(
                "number",
                f"station {station}: journal starts at {after.head.first_sequence}, minimum {last + RESTART_SKIP + 1}",
            )


@dataclass(slots=True)
class _StationLogFiles(StationLog):
    """A station log that is limited to intact journals."""

    intact: list[Path] = field(default_factory=list)

    @property
    def journals(self) -> list[Path]:
        """The intact journals, one per start."""
        return self.intact


def _log_of(path: Path) -> MasterLog:
    master_log = MasterLog(path.parent, lambda: 0, 0)
    master_log.measurements += [
        m for m in load_recording(path).measurements if isinstance(m, PolarMeasurement)
    ]
    return master_log


def _is_intact(path: Path, kind: str, report: FileReport) -> bool:
    """Check each line; return whether the file has its head lines."""
    *lines, tail = path.read_bytes().split(b"\n")
    report.counts[kind] += 1
    report.counts[f"lines of {kind}"] += len(lines)
    report.counts[f"torn tails of {kind}"] += bool(tail)
    for number, line in enumerate(lines, start=1):
        try:
            decode(Typed, line)
        except ValueError as error:
            report.violations.append(Violation("torn", f"{path}, line {number} of {len(lines)}: {error}"))
            return False
    if len(lines) < _HEAD_LINES:
        report.counts[f"{kind} without a head"] += 1
        return False
    try:  # the reader must skip a torn last line
        problems: list[RecordingError] = []
        (load_journal if kind == "journals" else load_recording)(path, on_problem=problems.append)
    except RecordingError as error:
        report.violations.append(Violation("torn", str(error)))
        return False
    if len(problems) != bool(tail):
        report.violations.append(Violation("torn", f"{path}: {len(problems)} lines skipped"))
    return True
