"""Writes the master's recording in a thread, so that a slow disk does not delay the radio."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from tsgt.errors import RecordingError
from tsgt.recording import RecordingStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.recording.recorder import Recorder


class RecordingThread:
    """Takes lines without waiting, writes them in a thread and reports which were written. Does not close the recorder.

    ``unix_now_ns``: the master's Unix clock.
    """

    def __init__(self, recorder: Recorder, unix_now_ns: Callable[[], int]) -> None:
        self._recorder = recorder
        self._unix_now_ns = unix_now_ns
        self._last_write_ns: int | None = None
        self.measurement_line = 0
        """Number of the line of the newest measurement."""
        self._pending = asyncio.Event()
        self._sync_requested = False
        self._sync_done = asyncio.Event()

    @property
    def error(self) -> RecordingError | None:
        """Why the last write failed; None if it did not."""
        return self._recorder.error

    def status(self, file: str) -> RecordingStatus:
        """Return the status of the recording with this file name."""
        return RecordingStatus(
            file=file,
            bytes=self._recorder.size,
            last_write_ns=self._last_write_ns,
            waiting_lines=self._recorder.pending,
            lost_lines=self._recorder.lost,
        )

    def put(self, line: bytes, *, measurement: bool = False) -> None:
        """Queue a line; ``measurement``: whether it is that of a measurement."""
        if measurement:
            self.measurement_line = self._recorder.line_count
        self._recorder.put(line)
        self._pending.set()

    def synced(self, number: int) -> bool | None:
        """Return whether a line is on the disk; False: it is lost, None: it is pending."""
        return self._recorder.synced(number)

    async def sync(self, timeout_s: float) -> None:
        """Bring all lines to the disk; wait until that has been tried, or for the timeout, after which it goes on."""
        self._sync_requested = True
        self._sync_done.clear()
        self._pending.set()
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._sync_done.wait()

    async def run(self) -> NoReturn:
        """Write until cancelled."""
        while True:
            await self._pending.wait()
            self._pending.clear()
            sync, self._sync_requested = self._sync_requested, False
            written_before = self._recorder.written_count
            await asyncio.to_thread(self._write_and_sync if sync else self._recorder.flush)
            if self._recorder.written_count > written_before:
                self._last_write_ns = self._unix_now_ns()
            if sync:
                self._sync_done.set()

    def _write_and_sync(self) -> None:
        self._recorder.flush()
        with suppress(RecordingError):  # logged by the periodic sync
            self._recorder.sync()
