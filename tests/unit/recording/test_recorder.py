"""The recorder on a failing disk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from harness.files.records import HEADER
from structlog.testing import capture_logs

from tsgt.errors import RecordingError
from tsgt.recording import RecordingWriter, encode_line
from tsgt.recording.recorder import Recorder

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


class FullDisk(RecordingWriter):
    """A real recording on a disk that the test can fill."""

    full = False

    def write_line(self, line: bytes) -> None:
        """Refuse the line, or write it."""
        if self.full:
            raise RecordingError("no room", path=self.path)
        super().write_line(line)

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.path = path


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[FullDisk]:
    """Open an empty recording."""
    with FullDisk(tmp_path / "run.jsonl") as writer:
        writer.write(HEADER)
        yield writer


def test_pending_lines_are_written_when_the_disk_recovers(disk: FullDisk) -> None:
    """In order; failure and recovery are logged once."""
    recorder = Recorder(disk)
    with capture_logs() as logs:
        for number in range(9):
            disk.full = 3 <= number < 6
            recorder.write_line(b"%d" % number)
    lines = disk.path.read_bytes().splitlines()
    assert lines == [encode_line(HEADER), *(b"%d" % number for number in range(9))]
    assert [entry["event"] for entry in logs] == ["recording_failed", "recording_recovered"]


def test_oldest_lines_are_lost_beyond_the_capacity(disk: FullDisk) -> None:
    """The log states how many."""
    recorder = Recorder(disk, max_pending_lines=4)
    with capture_logs() as logs:
        for number in range(10):
            disk.full = number < 9
            recorder.write_line(b"%d" % number)
    assert disk.path.read_bytes().splitlines()[1:] == [b"5", b"6", b"7", b"8", b"9"]
    assert logs[-1]["lost_lines"] == 5


def test_close_retries_pending_lines(disk: FullDisk) -> None:
    """It logs how many lines are lost."""
    recorder = Recorder(disk)
    with capture_logs() as logs:
        for full in (False, True):
            disk.full = True
            recorder.write_line(b"one")
            recorder.write_line(b"two")
            disk.full = full
            recorder.close()
    assert disk.path.read_bytes().splitlines()[1:] == [b"one", b"two"]
    assert logs[-1] == {"event": "recording_incomplete", "lost_lines": 2, "log_level": "error"}


def test_hanging_write_has_bounded_memory(disk: FullDisk) -> None:
    """The newest lines are lost and counted."""
    recorder = Recorder(disk, max_pending_lines=10)
    for _ in range(50):
        recorder.put(b"{}")
    assert recorder.pending == 20


def test_fate_of_a_line_can_be_queried(disk: FullDisk) -> None:
    """On the disk, pending or lost, by its number."""
    recorder = Recorder(disk, max_pending_lines=2)
    recorder.write_line(b"0")
    disk.full = True
    for number in range(1, 5):
        assert recorder.line_count == number
        recorder.put(b"%d" % number)
    recorder.sync()
    assert [recorder.synced(n) for n in range(5)] == [True, None, None, None, None]
    recorder.flush()
    assert [recorder.synced(n) for n in range(5)] == [True, False, False, None, None]
    disk.full = False
    recorder.flush()
    assert [recorder.synced(n) for n in range(5)] == [True, False, False, None, None]
    recorder.sync()
    assert [recorder.synced(n) for n in range(5)] == [True, False, False, True, True]


def test_line_beyond_the_hung_capacity_is_lost(disk: FullDisk) -> None:
    """Those before and after it are written."""
    recorder = Recorder(disk, max_pending_lines=1)
    for number in range(3):
        recorder.put(b"%d" % number)
    recorder.flush()
    recorder.write_line(b"3")
    recorder.sync()
    assert [recorder.synced(n) for n in range(4)] == [True, True, False, True]
