"""Detects a disk that is nearly full, is full or fails, for events on the stream; :class:`DiskMonitor` is sans-I/O."""

from __future__ import annotations

import asyncio
import errno
import shutil
from typing import TYPE_CHECKING, Literal, NoReturn

from tsgt.master.link_events import MasterEvent
from tsgt.recording import LOW_DISK_BYTES, DiskStatus

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.errors import RecordingError
    from tsgt.master.recording_thread import RecordingThread
    from tsgt.recording import RecordingStatus

DISK_SPACE_PERIOD_NS = 5_000_000_000

RECOVERY_FACTOR = 1.25  # of that space are free again before the disk counts as recovered

HUNG_DISK_TIMEOUT_NS = 10_000_000_000
"""Lines that wait for this long, while no write fails, wait for a disk that does not respond; a slow card takes seconds."""

_FULL = (errno.ENOSPC, errno.EDQUOT)

_State = Literal["ok", "low", "full", "failed"]


class DiskMonitor:
    """Monitors the disk of the recording; ``start_ns``: Unix time of the recording's start."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._state: _State = "ok"

    def update(
        self, now_ns: int, recording: RecordingStatus, error: RecordingError | None, disk: DiskStatus | None
    ) -> list[MasterEvent]:
        """Return the event of a change; ``error``: why the last write failed, None if it did not."""
        state, message = self._evaluate(now_ns, recording, error, disk)
        if state == self._state:
            return []
        self._state = state
        return [MasterEvent("disk_recovered" if state == "ok" else f"disk_{state}", message)]

    def _evaluate(
        self, now_ns: int, recording: RecordingStatus, error: RecordingError | None, disk: DiskStatus | None
    ) -> tuple[_State, str]:
        waiting = f"{recording.waiting_lines} lines wait in memory"
        if recording.lost_lines:
            waiting += f", {recording.lost_lines} are lost"
        if error is not None:
            cause = error.__cause__
            if isinstance(cause, OSError) and cause.errno in _FULL:
                return "full", f"the disk of the recording is full, {waiting}: free space"
            return "failed", f"the recording cannot be written, {waiting}: {error}"
        unwritten_since_ns = self._start_ns if recording.last_write_ns is None else recording.last_write_ns
        if recording.waiting_lines and now_ns - unwritten_since_ns > HUNG_DISK_TIMEOUT_NS:
            return "failed", f"the disk of the recording does not respond, {waiting}"
        if disk is None:
            return "ok", "the recording is written again"
        least = LOW_DISK_BYTES * (1 if self._state == "ok" else RECOVERY_FACTOR)
        if disk.free_bytes >= least:
            return "ok", f"the recording is written, {_gigabytes(disk.free_bytes)} are free"
        hours = disk.free_bytes / max(recording.bytes, 1) * (now_ns - self._start_ns) / 3.6e12
        return "low", (
            f"{_gigabytes(disk.free_bytes)} are free on the disk of the recording, enough for "
            f"{f'about {hours:.0f} h' if hours >= 1 else 'less than an hour'}: free space"
        )


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


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.1f} GB"
