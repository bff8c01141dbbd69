from __future__ import annotations

import errno
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from harness.files.records import HEADER, PARAMETERS, measurement, recording_bytes

from tsgt.errors import RecordingError, RecordingVersionError
from tsgt.recording import RecordingWriter, encode_line, load_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from typing_extensions import Buffer


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the recording is."""
    return tmp_path / "r.jsonl"


@pytest.fixture
def writer(path: Path) -> Iterator[RecordingWriter]:
    """Open a new recording with its first two lines."""
    with RecordingWriter(path) as opened:
        opened.write(HEADER)
        opened.write(PARAMETERS)
        yield opened


@dataclass
class Disk:
    """A nearly full disk: takes a part of a write, as a real one does, then none.

    A limit by the kernel (RLIMIT_FSIZE) would hold for all files of the process, the log of the test run included.
    """

    room_bytes: int
    real_write: Callable[[int, Buffer], int]

    def write(self, descriptor: int, data: Buffer) -> int:
        """Stand in for os.write."""
        if self.room_bytes <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = self.real_write(descriptor, memoryview(data)[: self.room_bytes])
        self.room_bytes -= written
        return written


@pytest.fixture
def disk(writer: RecordingWriter, monkeypatch: pytest.MonkeyPatch) -> Disk:  # noqa: ARG001 (after its first lines)
    """Leave room for thirty more bytes."""
    disk = Disk(30, os.write)
    monkeypatch.setattr(os, "write", disk.write)
    return disk


def test_line_is_readable_at_once(path: Path, writer: RecordingWriter) -> None:
    """Before any sync or close."""
    writer.write(measurement(0))
    writer.write_line(encode_line(measurement(1)))
    assert path.read_bytes() == recording_bytes(measurement(0), measurement(1))


def test_line_is_one_write(writer: RecordingWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line goes to the kernel in a single call, line end included."""
    written: list[bytes] = []

    def write(_: int, data: bytes) -> int:
        written.append(bytes(data))
        return len(data)

    monkeypatch.setattr(os, "write", write)
    writer.write(measurement(0))
    assert written == [encode_line(measurement(0)) + b"\n"]


def test_mode_is_0644(path: Path) -> None:
    """A new file can be read by everyone and written by its owner."""
    before = os.umask(0o022)
    try:
        RecordingWriter(path).close()
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o644


def test_session_is_appended(path: Path) -> None:
    """A reopened recording keeps its content."""
    path.write_bytes(recording_bytes(measurement(0)))
    with RecordingWriter(path) as writer:
        writer.write(measurement(1))
        assert writer.cut_bytes == 0
    assert load_recording(path).measurements == [measurement(0), measurement(1)]


def test_torn_tail_is_cut_off(path: Path) -> None:
    """A torn last line is removed when the file is opened for writing, and its length reported."""
    path.write_bytes(recording_bytes(measurement(0)) + b'{"type":"measurem')
    with RecordingWriter(path) as writer:
        writer.write(measurement(1))
        assert writer.cut_bytes == 17
    assert path.read_bytes() == recording_bytes(measurement(0), measurement(1))


def test_torn_tail_of_zeros_is_cut_off(path: Path) -> None:
    """A power cut can leave a long tail of zeros; it is removed, even if longer than any line."""
    path.write_bytes(recording_bytes(measurement(0)) + b"\0" * 3_000_000)
    with RecordingWriter(path) as writer:
        assert writer.cut_bytes == 3_000_000
    assert path.read_bytes() == recording_bytes(measurement(0))


def test_missing_newline_is_added(path: Path) -> None:
    """A last line that lacks nothing but its end keeps its place."""
    path.write_bytes(recording_bytes(measurement(0)).rstrip(b"\n"))
    with RecordingWriter(path) as writer:
        assert writer.cut_bytes == 0
    assert path.read_bytes() == recording_bytes(measurement(0))


def test_record_before_zeros_keeps_its_place(path: Path) -> None:
    """A power cut may leave zeros in place of the newline; they are removed, the record is not."""
    path.write_bytes(recording_bytes(measurement(0)).rstrip(b"\n") + b"\0" * 100)
    with RecordingWriter(path) as writer:
        assert writer.cut_bytes == 100
    assert path.read_bytes() == recording_bytes(measurement(0))


@pytest.mark.parametrize("kept_bytes", [0, 10, 25])
def test_header_that_a_power_cut_zeroed_is_cut_off(path: Path, kept_bytes: int) -> None:
    """Whether some of it had reached the disk or nothing at all."""
    path.write_bytes(encode_line(HEADER)[:kept_bytes] + b"\0" * 4096)
    with RecordingWriter(path) as writer:
        assert writer.cut_bytes == kept_bytes + 4096
    assert path.read_bytes() == b""


def test_torn_header_is_cut_off(path: Path) -> None:
    """A file that holds nothing but the beginning of a header becomes an empty one."""
    path.write_bytes(encode_line(HEADER)[:25])
    with RecordingWriter(path) as writer:
        assert writer.cut_bytes == 25
    assert path.read_bytes() == b""


@pytest.mark.parametrize(
    "content", [b"my notes", b"my notes\n", b"1 2 3 4\n5 6", b'{"type":"pose"}\n', b"\0x\0"]
)
def test_other_file_is_rejected_unchanged(path: Path, content: bytes) -> None:
    """Other file is rejected unchanged."""
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="header of a recording"):
        RecordingWriter(path)
    assert path.read_bytes() == content


def test_other_version_is_rejected_unchanged(path: Path) -> None:
    """Other version is rejected unchanged."""
    content = json.dumps(json.loads(encode_line(HEADER)) | {"version": 2}).encode() + b'\n{"to'
    path.write_bytes(content)
    with pytest.raises(RecordingVersionError, match="version 2, this program reads version 1"):
        RecordingWriter(path)
    assert path.read_bytes() == content


@pytest.mark.usefixtures("writer")
def test_second_writer_is_rejected(path: Path) -> None:
    """Second writer is rejected."""
    with pytest.raises(RecordingError, match="another program is writing it"):
        RecordingWriter(path)


def test_file_is_free_after_close(path: Path, writer: RecordingWriter) -> None:
    """Closing, also twice, releases the lock."""
    writer.close()
    writer.close()
    RecordingWriter(path).close()


def test_rejected_file_is_not_locked(path: Path) -> None:
    """Rejected file is not locked."""
    path.write_bytes(b"my notes\n")
    descriptors = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(RecordingError):
        RecordingWriter(path)
    assert len(list(Path("/proc/self/fd").iterdir())) == descriptors


@pytest.mark.parametrize("place", ["/dev/null", "/dev", "/proc/none", "/nowhere/r.jsonl"])
def test_impossible_place_is_one_line(place: str, tmp_path: Path) -> None:
    """A device, a folder or a missing folder is refused in one line that names it."""
    with pytest.raises(RecordingError, match=rf"^{place}: [^\n]+$"):
        RecordingWriter(tmp_path / place)


@pytest.mark.usefixtures("disk")
def test_full_disk_leaves_no_partial_line(path: Path, writer: RecordingWriter) -> None:
    """Full disk leaves no partial line."""
    with pytest.raises(
        RecordingError, match=r"^[^\n]*a line was not written \(No space left on device\)[^\n]*free[^\n]*$"
    ):
        writer.write(measurement(0))
    assert path.read_bytes() == recording_bytes()


def test_writing_continues_when_the_disk_recovers(path: Path, writer: RecordingWriter, disk: Disk) -> None:
    """Writing continues when the disk recovers."""
    with pytest.raises(RecordingError):
        writer.write(measurement(0))
    disk.room_bytes = 10_000
    writer.write(measurement(1))
    assert path.read_bytes() == recording_bytes(measurement(1))


def test_partial_line_is_removed_later(
    path: Path, writer: RecordingWriter, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the next line is written."""
    with monkeypatch.context() as patch:
        patch.setattr(os, "ftruncate", failing)
        with pytest.raises(RecordingError):
            writer.write(measurement(0))
    assert path.stat().st_size > len(recording_bytes())
    disk.room_bytes = 10_000
    writer.write(measurement(1))
    assert path.read_bytes() == recording_bytes(measurement(1))


def test_sync_reaches_the_disk_once(writer: RecordingWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sync is one fsync, and none when nothing was written since the last one."""
    calls: list[int] = []
    monkeypatch.setattr(os, "fsync", calls.append)
    writer.write(measurement(0))
    writer.sync()
    writer.sync()
    assert len(calls) == 1


def test_failed_sync_is_retried(writer: RecordingWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Failed sync is retried."""
    writer.write(measurement(0))
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", failing)
        for _ in range(2):
            with pytest.raises(RecordingError, match=r"cannot be brought to the disk \(broken\)"):
                writer.sync()
    writer.sync()


def test_lines_of_a_failed_sync_are_written_again(
    writer: RecordingWriter, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel takes them for written after one error, though they may never have reached the disk."""
    real, calls = os.pwrite, []

    def pwrite(descriptor: int, data: bytes, at: int) -> int:
        calls.append((bytes(data), at))
        return real(descriptor, data, at)

    monkeypatch.setattr(os, "pwrite", pwrite)
    writer.sync()
    synced_bytes = writer.size
    writer.write(measurement(0))
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", failing)
        with pytest.raises(RecordingError):
            writer.sync()
    assert calls == []
    writer.write(measurement(1))
    writer.sync()
    writer.write(measurement(2))
    writer.sync()
    expected = recording_bytes(*map(measurement, range(3)))
    assert calls == [
        (expected[synced_bytes : len(recording_bytes(*map(measurement, range(2))))], synced_bytes)
    ]
    assert path.read_bytes() == expected


def failing(*_: object) -> None:
    """Stand in for a system call on a broken disk."""
    raise OSError(5, "broken")
