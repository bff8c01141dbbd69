"""Writes the master's recording in a thread, so that a slow disk does not delay the radio."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from tsgt.recording.recorder import Recorder


class RecordingThread:
    """Takes lines without waiting, writes them in a thread and reports which were written. Does not close the recorder."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._pending = asyncio.Event()
        self._flushed = asyncio.Event()

    @property
    def line_count(self) -> int:
        """Lines put so far; the number of the next one."""
        return self._recorder.line_count

    def put(self, line: bytes) -> None:
        """Queue a line."""
        self._recorder.put(line)
        self._pending.set()

    def written(self, numbers: range) -> bool | None:
        """Return whether lines are in the file; False: one is lost, None: one is pending."""
        return self._recorder.written(numbers)

    async def flushed(self, timeout_s: float) -> bool:
        """Wait until some of the pending lines are written; return False after the timeout."""
        self._flushed.clear()
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                return await self._flushed.wait()
        return False

    async def run(self) -> NoReturn:
        """Write until cancelled."""
        while True:
            await self._pending.wait()
            self._pending.clear()
            await asyncio.to_thread(self._recorder.flush)
            self._flushed.set()
