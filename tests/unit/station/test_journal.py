"""The queue of a station's journal."""

from __future__ import annotations

import asyncio
import errno
import os
from typing import TYPE_CHECKING

from harness.files.records import HEADER

from tsgt.recording import RecordingWriter
from tsgt.recording.recorder import Recorder
from tsgt.station.journal import RETRY_INTERVAL_S, JournalQueue

if TYPE_CHECKING:
    from pathlib import Path


async def test_waiting_lines_are_written_without_another_line(tmp_path: Path) -> None:
    """The instrument may be unplugged by then, and the program killed."""
    full = True

    def write(descriptor: int, data: memoryview) -> int:
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return os.write(descriptor, data)

    with RecordingWriter(tmp_path / "journal.jsonl", write=write) as writer:
        recorder = Recorder(writer)
        queue = JournalQueue(recorder, write_timeout_s=None)
        writing = asyncio.create_task(queue.run())
        queue.write(HEADER, lambda: None)
        await asyncio.sleep(5.0)
        assert recorder.pending == 1
        full = False
        await asyncio.sleep(2 * RETRY_INTERVAL_S)
        assert recorder.pending == 0
        writing.cancel()
        await asyncio.wait([writing])
