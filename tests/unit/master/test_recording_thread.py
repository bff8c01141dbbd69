"""The recording behind a thread: lines are taken at once, and what became of them can be found out."""

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


async def test_lines_are_written_beside_everything_else(tmp_path: Path) -> None:
    """Who wants to know waits for the disk, but not for ever."""
    with RecordingWriter(tmp_path / "run.jsonl") as writer:
        writer.write(HEADER)
        disk = RecordingThread(Recorder(writer))
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
    assert (tmp_path / "run.jsonl").read_bytes().count(b"\n") == 3
