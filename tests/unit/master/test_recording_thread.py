"""The recording thread: lines are queued without waiting, and their fate can be queried."""

from __future__ import annotations

import asyncio
import errno
from typing import TYPE_CHECKING

from harness.files.records import HEADER
from harness.missions.field import running

from tsgt.master.recording_thread import RecordingThread
from tsgt.recording import RecordingWriter
from tsgt.recording.recorder import Recorder

if TYPE_CHECKING:
    from pathlib import Path


async def test_lines_are_written_in_the_background(tmp_path: Path) -> None:
    """Waiting for the disk has a time-out."""
    with RecordingWriter(tmp_path / "run.jsonl") as writer:
        writer.write(HEADER)
        disk = RecordingThread(Recorder(writer), lambda: 7)
        disk.put(b"{}")
        await disk.sync(0.015)
        assert disk.synced(0) is None  # nobody writes
        async with running(disk.run()):
            await disk.sync(0.015)
            assert disk.synced(0) is True
            disk.put(b"{}")
            await asyncio.sleep(0.015)
            assert disk.status("run.jsonl").waiting_lines == 0
            assert disk.synced(1) is None  # written, but a power cut would take it
            await disk.sync(0.015)
            assert disk.synced(1) is True
        status = disk.status("run.jsonl")
    assert (tmp_path / "run.jsonl").stat().st_size == status.bytes
    assert (status.last_write_ns, status.waiting_lines, status.lost_lines) == (7, 0, 0)
    assert (tmp_path / "run.jsonl").read_bytes().count(b"\n") == 3


async def test_disk_that_fails_to_sync_is_not_waited_for(tmp_path: Path) -> None:
    """Its lines do not count as synced until it works again."""
    broken = True

    def sync(_file: int) -> None:
        if broken:
            raise OSError(errno.EIO, "broken")

    with RecordingWriter(tmp_path / "run.jsonl", sync=sync) as writer:
        writer.write(HEADER)
        disk = RecordingThread(Recorder(writer), lambda: 7)
        async with running(disk.run()):
            disk.put(b"{}")
            await disk.sync(1e6)
            assert disk.synced(0) is None
            broken = False
            await disk.sync(1e6)
            assert disk.synced(0) is True
