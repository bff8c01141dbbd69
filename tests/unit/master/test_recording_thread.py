"""The recording thread: lines are queued without waiting, and their fate can be queried."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from harness.field import running
from harness.records import HEADER

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
        assert disk.written(range(1)) is None
        assert not await disk.flushed(0.015)  # nobody writes
        async with running(disk.run()):
            assert await disk.flushed(0.015)
            assert disk.written(range(disk.line_count)) is True
            assert not await disk.flushed(0.015)  # nothing to do
            disk.put(b"{}")
            await asyncio.sleep(0)
            assert await disk.flushed(0.015)
        status = disk.status("run.jsonl")
    assert (tmp_path / "run.jsonl").stat().st_size == status.bytes
    assert (status.last_write_ns, status.waiting_lines, status.lost_lines) == (7, 0, 0)
    assert (tmp_path / "run.jsonl").read_bytes().count(b"\n") == 3
