"""The disk of a simulated computer: it fills up, turns read-only, and programs are killed while they write to it."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

UNWRITTEN_NS = 100_000_000
"""What a client has read within so long before it is killed need not be in its journal."""

FULL = errno.ENOSPC
READ_ONLY = errno.EROFS


RECOVERY_NS = 2_000_000_000
"""Within so long a program has written what waited for a disk that takes it again."""


@dataclass(slots=True)
class SimulatedDisk:
    """What is the same for all programs that one after the other run on a computer.

    Attributes
    ----------
    refuses
        The error with which it refuses to be written to, :data:`FULL` or :data:`READ_ONLY`; None: it takes everything.
    """

    refuses: int | None = None
    _refused_ns: tuple[int, int] | None = None

    def refuse(self, error: int, since_ns: int, until_ns: int) -> None:
        """Refuse everything with an error; when that is to end is for :meth:`unwritten_since_ns` alone."""
        if self._refused_ns is not None and since_ns <= self._refused_ns[1] + RECOVERY_NS:
            since_ns, until_ns = self._refused_ns[0], max(until_ns, self._refused_ns[1])
        self.refuses = error
        self._refused_ns = (since_ns, until_ns)

    def unwritten_since_ns(self, now_ns: int) -> int:
        """Return since when a program may not have been able to write, for one that is killed now; true times in ns."""
        if self._refused_ns is None or now_ns > self._refused_ns[1] + RECOVERY_NS:
            return now_ns - UNWRITTEN_NS
        return self._refused_ns[0]


class Killed(BaseException):
    """A program that was killed would have written.

    No ``except Exception`` of the program takes it for a fault of the disk.
    """


class ProgramWrites:
    """How one run of a program writes to its computer's disk, until the program is killed.

    Parameters
    ----------
    disk
        Of its computer.
    """

    def __init__(self, disk: SimulatedDisk) -> None:
        self._disk = disk
        self._dead = False
        self._tear: tuple[float, Callable[[], object]] | None = None

    def write(self, fd: int, data: memoryview) -> int:
        """Write like :func:`os.write`; a full disk takes the first bytes of a line before it refuses the rest.

        Raises
        ------
        OSError
            The disk refuses.
        Killed
            The program is no more.
        """
        if self._dead:
            raise Killed
        if self._disk.refuses == FULL and len(data) > 1:
            return os.write(fd, data[: len(data) // 2])
        if self._disk.refuses is not None:
            raise OSError(self._disk.refuses, os.strerror(self._disk.refuses))
        if self._tear is not None:
            share, then = self._tear
            self.die()
            if kept := data[: int(share * len(data))]:
                os.write(fd, kept)
            then()
            raise Killed
        return os.write(fd, data)

    def tear(self, share: float, then: Callable[[], object]) -> None:
        """Kill the program in the middle of its next line.

        Parameters
        ----------
        share
            Of the line that gets to the disk, from 0 to 1.
        then
            Called, perhaps from another thread, when it has happened.
        """
        self._tear = (share, then)

    def die(self) -> None:
        """Take nothing any more: the program is no more, whatever is left of it here."""
        self._dead = True
        self._tear = None
