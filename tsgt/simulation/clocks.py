"""Clocks of the simulation."""

from __future__ import annotations

import asyncio


class VirtualClock:
    """The time of the running event loop, so that a loop on virtual time carries everything with it.

    Parameters
    ----------
    unix_at_zero_ns
        Unix time in ns when the loop's time is zero.
    """

    def __init__(self, unix_at_zero_ns: int) -> None:
        self._unix_at_zero_ns = unix_at_zero_ns

    def monotonic_ns(self) -> int:
        """Return the loop's time in nanoseconds."""
        return round(asyncio.get_running_loop().time() * 1e9)

    def realtime_ns(self) -> int:
        """Return the Unix time in nanoseconds that belongs to it."""
        return self._unix_at_zero_ns + self.monotonic_ns()

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Sleep on the event loop; an instant that has passed still lets other tasks run once."""
        await asyncio.sleep(max(0, monotonic_ns - self.monotonic_ns()) / 1e9)
