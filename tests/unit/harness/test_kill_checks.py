"""Checks of the files of killed daemons: intact files pass, each defect is found."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.files.records import HEADER, PARAMETERS, measurement
from harness.missions.kill_checks import check_files_after_kills

from tsgt.radio.superframe.wire import RESTART_SKIP
from tsgt.recording import encode_line
from tsgt.recording.journal import JournalRecord
from tsgt.simulation.instrument import ReportedDistance
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from harness.missions.kill_checks import FileReport

    from tsgt.model import PolarMeasurement

MS = 1_000_000
ZERO_NS = 1_700_000_000_000_000_000


def journalled(number: int) -> PolarMeasurement:
    """Return a measurement of station 1 as journalled."""
    made_ns = 400 * MS * number
    stamp_ns = ZERO_NS + made_ns
    return replace(
        measurement(number),
        station=1,
        sequence=number,
        stamp_ns=stamp_ns,
        host_time_ns=stamp_ns,
        received_ns=stamp_ns,
        instrument_time_ns=made_ns,
        slope_distance_m=40.0 + 0.001 * number,
    )


SECOND_START = 5 + RESTART_SKIP


def delivered(number: int, *, late_ns: int = 0) -> PolarMeasurement:
    """Return the measurement as recorded; the master's Unix clock is ahead by a minute."""
    stamp_ns = journalled(number).stamp_ns + 60_000 * MS + late_ns
    return replace(
        journalled(number), stamp_ns=stamp_ns, host_time_ns=None, received_ns=stamp_ns, stamp_bound_ns=200_000
    )


class KilledDaemonFiles:
    """Two journals of a client that was killed once, and two recordings of a master likewise."""

    def __init__(self, folder: Path) -> None:
        self.journals, self.recordings = folder / "journals1", folder / "recordings"
        self.journals.mkdir()
        self.recordings.mkdir()
        self.journal("a", 0, range(5))
        self.journal("b", SECOND_START, range(SECOND_START, SECOND_START + 5))
        self.recording("a", [delivered(number) for number in range(4)])
        self.recording("b", [delivered(number) for number in (3, 4, *range(SECOND_START, SECOND_START + 5))])

    def journal(self, name: str, first_sequence: int, numbers: Sequence[int], *, stream_id: int = 7) -> Path:
        """Write a journal."""
        head = JournalRecord(
            station=1,
            unix_at_zero_ns=ZERO_NS,
            boot="boot",
            stream_id=stream_id,
            first_sequence=first_sequence,
        )
        return self._write(self.journals / f"{name}.jsonl", [HEADER, head, *map(journalled, numbers)])

    def recording(self, name: str, measurements: Sequence[PolarMeasurement]) -> Path:
        """Write a recording."""
        return self._write(self.recordings / f"{name}.jsonl", [HEADER, PARAMETERS, *measurements])

    def _write(self, path: Path, records: Sequence[object]) -> Path:
        path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records))
        return path

    def report(self, *, queued: int = 0) -> FileReport:
        """Run the checks."""
        numbers = (*range(5), *range(SECOND_START, SECOND_START + 5))
        offered = [
            ReportedDistance(
                instrument_ms=400 * number,
                true_ns=400 * MS * number,
                horizontal_angle_rad=journalled(number).horizontal_angle_rad,
                zenith_angle_rad=journalled(number).zenith_angle_rad,
                distance_m=40.0 + 0.001 * number,
                prism=journalled(number).prism,
                code=ReturnCode.OK,
            )
            for number in numbers
        ]
        recordings = sorted(self.recordings.iterdir())
        return check_files_after_kills(recordings, {1: self.journals}, {1: offered}, {1: queued})

    def checks(self, *, queued: int = 0) -> set[str]:
        """Return the names of the violated checks."""
        return {violation.check for violation in self.report(queued=queued).violations}


@pytest.fixture
def files(tmp_path: Path) -> KilledDaemonFiles:
    """Return intact files."""
    return KilledDaemonFiles(tmp_path)


def test_intact_files_have_no_violations(files: KilledDaemonFiles) -> None:
    """A measurement may be recorded by two masters, if its acknowledgement was lost."""
    report = files.report()
    assert report.violations == []
    assert report.counts["measurements recorded"] == report.counts["measurements journalled"] == 10
    assert report.counts["recorded by two masters"] == 1


def test_torn_last_line_is_accepted(files: KilledDaemonFiles) -> None:
    """Incomplete last lines and headers are counted; a torn line before the last is a violation."""
    for folder in (files.journals, files.recordings):
        with (folder / "b.jsonl").open("ab") as file:
            file.write(b'{"type":"meas')
        (folder / "c.jsonl").touch()
        (folder / "d.jsonl").write_bytes(encode_line(HEADER) + b"\n" + b'{"ty')
    report = files.report()
    assert report.violations == []
    assert report.counts["torn tails of journals"] == report.counts["torn tails of recordings"] == 2
    assert report.counts["journals without a head"] == report.counts["recordings without a head"] == 2
    with (files.journals / "a.jsonl").open("ab") as file:
        file.write(b'{"type":"meas\n')
    assert "torn" in files.checks()


def test_incomplete_record_is_found(files: KilledDaemonFiles) -> None:
    """A measurement without its station."""
    with (files.journals / "a.jsonl").open("ab") as file:
        file.write(b'{"type":"measurement"}\n')
    assert "torn" in files.checks()


def test_lost_measurement_is_found(files: KilledDaemonFiles) -> None:
    """Unless it is in the queue."""
    files.recording("b", [delivered(number) for number in range(SECOND_START, SECOND_START + 4)])
    assert files.checks(queued=2) == set()
    assert files.checks(queued=1) == {"lost"}


def test_duplicate_in_a_recording_is_found(files: KilledDaemonFiles) -> None:
    """Within one recording."""
    files.recording("a", [delivered(number) for number in (0, 1, 2, 3, 3)])
    assert files.checks() == {"duplicate"}


def test_reused_sequence_number_is_found(files: KilledDaemonFiles) -> None:
    """By a restart that continues too early, restarts at zero, or skips a number."""
    files.journal("b", SECOND_START - 1, range(SECOND_START, SECOND_START + 5))
    assert "number" in files.checks()
    files.journal("b", SECOND_START, range(SECOND_START, SECOND_START + 5), stream_id=8)
    assert files.checks() == {"number"}
    files.journal(
        "b",
        SECOND_START,
        (SECOND_START, SECOND_START + 2, SECOND_START + 1, SECOND_START + 3, SECOND_START + 4),
    )
    assert files.checks() == {"number"}


def test_altered_measurement_is_found(files: KilledDaemonFiles) -> None:
    """The recording differs from the journal."""
    other = replace(delivered(2), slope_distance_m=41.0)
    files.recording("a", [delivered(0), delivered(1), other, delivered(3)])
    assert files.checks() == {"journal"}


def test_timestamp_beyond_its_bound_is_found(files: KilledDaemonFiles) -> None:
    """Whatever the master's Unix clock showed."""
    late = delivered(2, late_ns=2_097_152_000)
    files.recording("a", [delivered(0), delivered(1), late, delivered(3)])
    assert files.checks() == {"time"}
