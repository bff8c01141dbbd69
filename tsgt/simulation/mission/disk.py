"""Disk of a simulated computer, with write errors and kills during a write."""

from __future__ import annotations

import asyncio
import errno
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.recording import DiskStatus
from tsgt.simulation.kernel import VirtualEventLoop

if TYPE_CHECKING:
    from collections.abc import Callable

UNWRITTEN_WINDOW_NS = 100_000_000
"""A client need not have journalled what it read within this time before it was killed."""

WRITE_RECOVERY_NS = 2_000_000_000
"""After the end of a write error, a daemon has written its backlog within this time."""


@dataclass(slots=True)
class SimulatedDisk:
    """State of a disk, shared by all daemons that run on a computer."""

    write_error: int | None = None  # error number of all writes, ENOSPC or EROFS; None: writes succeed
    stalled_until_ns: int = 0  # true time until which writes and syncs in a thread wait
    _failure_ns: tuple[int, int] | None = None

    def status(self) -> DiskStatus:
        """Return its space."""
        return DiskStatus(
            free_bytes=0 if self.write_error == errno.ENOSPC else _FREE_BYTES, total_bytes=_TOTAL_BYTES
        )

    def fail_writes(self, error: int, since_ns: int, until_ns: int) -> None:
        """Fail all writes with an error. The end time only informs :meth:`failing_since_ns`; reset ``write_error`` to end."""
        self.write_error = error
        self._note_failure(since_ns, until_ns)

    def stall(self, since_ns: int, until_ns: int) -> None:
        """Delay writes and syncs, as the housekeeping of an SD card does; true times in ns."""
        self.stalled_until_ns = max(self.stalled_until_ns, until_ns)
        self._note_failure(since_ns, until_ns)

    def wait(self) -> None:
        """Wait for the end of a stall, if called in the executor of a virtual event loop."""
        if self.stalled_until_ns and isinstance(loop := asyncio.get_running_loop(), VirtualEventLoop):
            loop.block_executor_work(self.stalled_until_ns)

    def _note_failure(self, since_ns: int, until_ns: int) -> None:
        if self._failure_ns is not None and since_ns <= self._failure_ns[1] + WRITE_RECOVERY_NS:
            since_ns, until_ns = self._failure_ns[0], max(until_ns, self._failure_ns[1])
        self._failure_ns = (since_ns, until_ns)

    def failing_since_ns(self, now_ns: int) -> int:
        """Return since when a daemon that is killed now may have been unable to write; true times in ns."""
        if self._failure_ns is None or now_ns > self._failure_ns[1] + WRITE_RECOVERY_NS:
            return now_ns - UNWRITTEN_WINDOW_NS
        return self._failure_ns[0]


_TOTAL_BYTES = 32_000_000_000
_FREE_BYTES = 20_000_000_000


class ProcessKilled(BaseException):
    """A killed daemon tried to write; a BaseException, so that the daemon does not handle it as a disk error."""


class DiskWriter:
    """Disk access of one daemon, until it is killed."""

    def __init__(self, disk: SimulatedDisk) -> None:
        self._disk = disk
        self._killed = False
        self._tear: tuple[float, Callable[[], object]] | None = None

    def write(self, fd: int, data: memoryview) -> int:
        """Write like :func:`os.write`; a full disk accepts the first half of a line.

        Raises
        ------
        OSError
            The disk fails.
        ProcessKilled
            The daemon was killed.
        """
        if self._killed:
            raise ProcessKilled
        self._disk.wait()
        if self._disk.write_error == errno.ENOSPC and len(data) > 1:
            return os.write(fd, data[: len(data) // 2])
        if self._disk.write_error is not None:
            raise OSError(self._disk.write_error, os.strerror(self._disk.write_error))
        if self._tear is not None:
            share, then = self._tear
            self.kill()
            if kept := data[: int(share * len(data))]:
                os.write(fd, kept)
            then()
            raise ProcessKilled
        return os.write(fd, data)

    def sync(self, _fd: int) -> None:
        """Do nothing, after a stall: a simulated power failure loses nothing that was written."""
        self._disk.wait()

    def tear_next_write(self, share: float, then: Callable[[], object]) -> None:
        """Kill the daemon during its next write, of which a share (0 to 1) reaches the disk, and call ``then`` in that thread."""
        self._tear = (share, then)

    def kill(self) -> None:
        """Fail all further writes with :class:`ProcessKilled`."""
        self._killed = True
        self._tear = None
