"""The master's recording behind a thread: a disk that takes its time must not keep the radio waiting."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from tsgt.recording.recorder import Recorder


class Disk:
    """Takes lines at once and writes them in a thread; tells what has become of them.

    Parameters
    ----------
    recorder
        Of the open recording; the owner closes it.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._unwritten = asyncio.Event()
        self._flushed = asyncio.Event()

    @property
    def taken(self) -> int:
        """How many lines have been put; the number of the next one."""
        return self._recorder.taken

    def put(self, line: bytes) -> None:
        """Take a line."""
        self._recorder.put(line)
        self._unwritten.set()

    def written(self, numbers: range) -> bool | None:
        """Tell whether lines are in the file; False: one is lost, None: one still waits."""
        return self._recorder.written(numbers)

    async def flushed(self, timeout_s: float) -> bool:
        """Wait until the disk has taken what waited, all or some; return False when nothing happens for so long."""
        self._flushed.clear()
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                return await self._flushed.wait()
        return False

    async def run(self) -> NoReturn:
        """Write for ever."""
        while True:
            await self._unwritten.wait()
            self._unwritten.clear()
            await asyncio.to_thread(self._recorder.flush)
            self._flushed.set()
