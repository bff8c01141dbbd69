"""Writes the master's recording in a thread, so that a slow disk does not delay the radio."""

from __future__ import annotations

import asyncio
import shutil
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from tsgt.errors import RecordingError
from tsgt.master.monitors import DiskMonitor
from tsgt.recording import DiskStatus, RecordingStatus

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.master.link_events import MasterEvent
    from tsgt.recording.recorder import Recorder


DISK_SPACE_PERIOD_NS = 5_000_000_000


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


class RecordingDisk:
    """The recording and the space on its disk; ``space`` is None before the first measurement of it."""

    def __init__(
        self,
        recording: RecordingThread,
        path: Path,
        start_ns: int,
        disk_status: Callable[[Path], DiskStatus | None],
    ) -> None:
        self._recording = recording
        self._path = path
        self._monitor = DiskMonitor(start_ns)
        self._disk_status = disk_status
        self.space: DiskStatus | None = None

    async def measure_space(self, clock: Clock) -> NoReturn:
        """Measure the space periodically, in a thread: a disk may not respond."""
        while True:
            self.space = await asyncio.to_thread(self._disk_status, self._path.parent)
            await clock.sleep_until(clock.monotonic_ns() + DISK_SPACE_PERIOD_NS)

    def recording_status(self) -> RecordingStatus:
        """Return the status of the recording."""
        return self._recording.status(self._path.name)

    def events(self, now_ns: int) -> list[MasterEvent]:
        """Return the events of a disk that has filled up, failed or recovered."""
        return self._monitor.update(now_ns, self.recording_status(), self._recording.error, self.space)


def disk_status(directory: Path) -> DiskStatus | None:
    """Return the space on the disk of a directory; None if it cannot be determined. May wait for the disk."""
    try:
        usage = shutil.disk_usage(directory)
    except OSError:
        return None
    return DiskStatus(free_bytes=usage.free, total_bytes=usage.total)
