"""Clocks, passed to every part that needs the time.

Internally, time is CLOCK_MONOTONIC, which no operator and no NTP daemon can set. The stream and recordings have the master's
Unix clock. A mapping that is fixed at the start of a program (:class:`UnixTimeline`) relates them, so that a step of the
Unix clock never distorts a trajectory.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from tsgt.errors import ComputerSuspendedError

if TYPE_CHECKING:
    from collections.abc import Callable

_SUSPENDED_TOLERANCE_NS = (
    5_000_000  # more than the time between readings of two clocks, less than any suspension
)


class Clock(Protocol):
    """A clock of the machine or of the simulation."""

    def monotonic_ns(self) -> int:
        """Return the time in nanoseconds of a clock that is never set; only differences are meaningful."""
        ...

    def realtime_ns(self) -> int:
        """Return the machine's Unix time in nanoseconds."""
        ...

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Return when :meth:`monotonic_ns` has reached a value."""
        ...


class SystemClock:
    """The machine's clocks and the event loop's timer."""

    def monotonic_ns(self) -> int:
        """Return CLOCK_MONOTONIC in nanoseconds."""
        return time.monotonic_ns()

    def realtime_ns(self) -> int:
        """Return CLOCK_REALTIME in nanoseconds."""
        return time.time_ns()

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Sleep on the event loop; other tasks run once even if the instant has passed."""
        await asyncio.sleep(max(0, monotonic_ns - self.monotonic_ns()) / 1e9)


def boot_id() -> str:
    """Return the kernel's boot id, which identifies the origin of CLOCK_MONOTONIC; empty where unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def suspended_ns() -> int:
    """Return for how long this computer has been suspended since it was started; meanwhile CLOCK_MONOTONIC stood still."""
    if not hasattr(time, "CLOCK_BOOTTIME"):  # not Linux
        return 0
    return _ahead_ns(lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME), time.monotonic_ns)


def _ahead_ns(clock_ns: Callable[[], int], monotonic_ns: Callable[[], int]) -> int:
    """Return by how much a clock is ahead of another one.

    Each reading of it lies between two of the other clock. An interruption spreads these; the closest pair counts.
    """
    readings = []
    for _ in range(3):
        before_ns, at_ns, after_ns = monotonic_ns(), clock_ns(), monotonic_ns()
        readings.append((after_ns - before_ns, at_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


class SuspensionWatch:
    """Notices that the computer was suspended: times of CLOCK_MONOTONIC from before do not compare with later ones.

    ``suspended_ns``: see :func:`suspended_ns`.
    """

    def __init__(self, suspended_ns: Callable[[], int]) -> None:
        self._suspended_ns = suspended_ns
        self._before_ns = suspended_ns()

    def boot(self, boot: str) -> str:
        """Return the identity of CLOCK_MONOTONIC's origin: of the boot, and of the suspensions since then; empty where unknown."""
        if not boot or self._before_ns < _SUSPENDED_TOLERANCE_NS:
            return boot
        return f"{boot}+{round(self._before_ns / 1e7)}"

    def check(self) -> None:
        """Raise ComputerSuspendedError if the computer was suspended since this watch began."""
        suspended_ns = self._suspended_ns() - self._before_ns
        if suspended_ns > _SUSPENDED_TOLERANCE_NS:
            raise ComputerSuspendedError(suspended_ns / 1e9)


def first_suspension(errors: BaseExceptionGroup[ComputerSuspendedError]) -> ComputerSuspendedError:
    """Return the first error of a group, which may contain groups."""
    error: BaseException = errors
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    if not isinstance(error, ComputerSuspendedError):
        raise TypeError(f"expected ComputerSuspendedError, got {error!r}")
    return error


@dataclass(frozen=True, slots=True)
class UnixTimeline:
    """The mapping from CLOCK_MONOTONIC to Unix time, fixed from the start of a program to its end."""

    unix_at_zero_ns: int
    """Unix time in nanoseconds at monotonic zero."""

    @classmethod
    def fixed_now(cls, clock: Clock) -> UnixTimeline:
        """Compare both clocks now."""
        return cls(_ahead_ns(clock.realtime_ns, clock.monotonic_ns))

    def unix_ns(self, monotonic_ns: int) -> int:
        """Convert a monotonic instant to Unix time, in nanoseconds."""
        return self.unix_at_zero_ns + monotonic_ns

    def monotonic_ns(self, unix_ns: int) -> int:
        """Convert a Unix time on this timeline to a monotonic instant, in nanoseconds."""
        return unix_ns - self.unix_at_zero_ns
