"""Time, handed in: what the program asks the machine about time stands behind one protocol.

Inside, time is CLOCK_MONOTONIC, which no operator and no NTP daemon can set. On the stream and on disk it is
the master's Unix clock. The two are tied by one mapping, fixed at the start of a program
(:class:`UnixTimeline`), so that a step of the Unix clock never bends a trajectory.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


class Clock(Protocol):
    """What a program may ask about time. Implemented by the machine and by the simulation."""

    def monotonic_ns(self) -> int:
        """Nanoseconds of a clock that nobody sets; only differences mean anything."""
        ...

    def realtime_ns(self) -> int:
        """Nanoseconds since the Unix epoch, as the machine believes at this moment."""
        ...

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Return when :meth:`monotonic_ns` has reached the given value, at once if it has."""
        ...


class SystemClock:
    """The machine's own clocks and the event loop's timer."""

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC in nanoseconds."""
        return time.monotonic_ns()

    def realtime_ns(self) -> int:
        """CLOCK_REALTIME in nanoseconds."""
        return time.time_ns()

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Sleep on the event loop; an instant that has passed still lets other tasks run once."""
        await asyncio.sleep(max(0, monotonic_ns - self.monotonic_ns()) / 1e9)


def boot_id() -> str:
    """Return what names the present start of this machine, from which CLOCK_MONOTONIC counts; empty where unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""


@dataclass(frozen=True, slots=True)
class UnixTimeline:
    """The one mapping from CLOCK_MONOTONIC to Unix time that a program keeps from start to end.

    Attributes
    ----------
    unix_at_zero_ns
        Unix time in nanoseconds at monotonic zero.
    """

    unix_at_zero_ns: int

    @classmethod
    def fixed_now(cls, clock: Clock) -> UnixTimeline:
        """Read both clocks once and keep their difference."""
        return cls(clock.realtime_ns() - clock.monotonic_ns())

    def unix_ns(self, monotonic_ns: int) -> int:
        """Unix time of a monotonic instant, in nanoseconds."""
        return self.unix_at_zero_ns + monotonic_ns

    def monotonic_ns(self, unix_ns: int) -> int:
        """Monotonic instant of a Unix time on this timeline, in nanoseconds."""
        return unix_ns - self.unix_at_zero_ns
