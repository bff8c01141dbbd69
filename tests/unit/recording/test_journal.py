"""Reading journals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from harness.files.records import HEADER, PARAMETERS, measurement

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.model import Status
from tsgt.recording import encode_line
from tsgt.recording.journal import (
    JournalRecord,
    ReceptionRecord,
    TargetRecord,
    is_unfinished_journal,
    load_journal,
)

if TYPE_CHECKING:
    from pathlib import Path

HEAD = JournalRecord(station=1, unix_at_zero_ns=5)
TARGET = TargetRecord(
    station=1,
    stamp_ns=7,
    horizontal_angle_rad=0.1,
    zenith_angle_rad=1.5,
    slope_distance_m=None,
    status=Status.ANGLE_ONLY,
    raw_status=4,
    instrument_time_ns=None,
)


def write(path: Path, *records: object, tail: bytes = b"") -> Path:
    """Write lines as they stand in a file."""
    path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records) + tail)
    return path


def test_journal_round_trip(tmp_path: Path) -> None:
    """A torn last line is reported and skipped."""
    problems: list[RecordingError] = []
    path = write(
        tmp_path / "j.jsonl", HEADER, HEAD, measurement(0), TARGET, measurement(1), tail=b'{"type":"mea'
    )
    journal = load_journal(path, on_problem=problems.append)
    assert journal.station == 1
    assert journal.measurements == [measurement(0), measurement(1)]
    assert journal.targets == [TARGET]
    assert "torn" in str(problems[0])


@pytest.mark.parametrize("kept_bytes", [0, 25])
def test_journal_that_a_power_cut_zeroed_is_unfinished(tmp_path: Path, kept_bytes: int) -> None:
    """It began less than a second before the cut, and holds no measurement."""
    path = tmp_path / "j.jsonl"
    path.write_bytes(encode_line(HEADER)[:kept_bytes] + b"\0" * 4096)
    assert is_unfinished_journal(path)


def test_recording_is_not_a_journal(tmp_path: Path) -> None:
    """Recording is not a journal."""
    path = write(tmp_path / "r.jsonl", HEADER, PARAMETERS, measurement(0))
    with pytest.raises(RecordingError, match="is not a station's journal"):
        load_journal(path)


def test_two_journals_in_one_file_are_rejected(tmp_path: Path) -> None:
    """Their times would be of different clocks."""
    other = JournalRecord(station=1, unix_at_zero_ns=6)
    path = write(tmp_path / "j.jsonl", HEADER, HEAD, measurement(0), HEADER, other)
    with pytest.raises(CorruptLineError, match="line 5: begins a second journal"):
        load_journal(path)


def test_invalid_target_is_an_error(tmp_path: Path) -> None:
    """With field and line."""
    line = encode_line(TARGET).replace(b'"stamp_ns":7', b'"stamp_ns":-1')
    path = write(tmp_path / "j.jsonl", HEADER, HEAD, tail=line + b"\n")
    with pytest.raises(CorruptLineError, match="line 3"):
        load_journal(path)


def test_receptions_are_read(tmp_path: Path) -> None:
    """Receptions are read."""
    reception = ReceptionRecord(stamp_ns=7, stamp_sigma_ns=1, session=2, counter=3, sent_us=4)
    journal = load_journal(write(tmp_path / "j.jsonl", HEADER, HEAD, reception))
    assert journal.head == HEAD
    assert journal.created_ns == HEADER.created_ns
    assert journal.receptions == [reception]


def test_corrupt_lines_are_skipped_if_requested(tmp_path: Path) -> None:
    """Each is reported; the head must be valid."""
    problems: list[RecordingError] = []
    wrong = encode_line(TARGET).replace(b'"stamp_ns":7', b'"stamp_ns":-1') + b"\n"
    path = write(tmp_path / "j.jsonl", HEADER, HEAD, tail=b"rubbish\n" + wrong + encode_line(TARGET) + b"\n")
    journal = load_journal(path, keep_going=True, on_problem=problems.append)
    assert journal.targets == [TARGET]
    assert [problem.line for problem in problems] == [3, 4]
    path = write(tmp_path / "j.jsonl", HEADER, HEAD, JournalRecord(station=2, unix_at_zero_ns=5))
    with pytest.raises(CorruptLineError, match="begins a second journal"):
        load_journal(path, keep_going=True)
