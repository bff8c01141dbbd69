"""Clocks of the simulation: the true time, and computers whose clocks run fast or slow against it."""

from __future__ import annotations

import asyncio
from bisect import bisect_right
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple, Protocol

from tsgt.clock import Clock

if TYPE_CHECKING:
    from collections.abc import Iterable


class SimulatedClock(Clock, Protocol):
    """A clock that knows its own error, so that simulated hardware can be stamped with it."""

    def local_ns(self, true_ns: int) -> int:
        """Return what :meth:`monotonic_ns` shows at a true time, both in nanoseconds."""
        ...

    def true_ns(self, local_ns: int) -> int:
        """Return the first true time at which :meth:`monotonic_ns` shows at least this, both in nanoseconds."""
        ...


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

    def step(self, by_ns: int) -> None:
        """Set the Unix clock, as an operator or NTP does; CLOCK_MONOTONIC goes on. Positive: forward."""
        self._unix_at_zero_ns += by_ns

    def local_ns(self, true_ns: int) -> int:
        """Return the same: this clock is the truth."""
        return true_ns

    def true_ns(self, local_ns: int) -> int:
        """Return the same: this clock is the truth."""
        return local_ns


class DriftingClock:
    """The clock of a computer that is not the master's: another Unix time, a crystal that runs fast or slow.

    Parameters
    ----------
    true
        The true time, which the master's clock shows.
    offset_ns
        Its Unix clock against the true one at true zero, in ns; positive: this clock is ahead.
    drift_ppm
        By how much it gains on the true time, in 1e-6; positive: it runs fast.
    drift_steps
        Later drifts (a crystal gets warm): each from a true time in ns on, in 1e-6. In any order.
    booted_ns
        True time at which the computer was switched on, in ns.
    """

    def __init__(
        self,
        true: Clock,
        *,
        offset_ns: int = 0,
        drift_ppm: float = 0.0,
        drift_steps: Iterable[tuple[int, float]] = (),
        booted_ns: int = 0,
    ) -> None:
        self._true = true
        self._offset_ns = offset_ns
        steps = sorted(drift_steps)
        self._stretches = [
            _Stretch(booted_ns, 0, max((s for s in steps if s[0] <= booted_ns), default=(0, drift_ppm))[1])
        ]
        for from_ns, ppm in steps:
            if from_ns > booted_ns:
                self._stretches.append(_Stretch(from_ns, self.local_ns(from_ns), ppm))

    def monotonic_ns(self) -> int:
        """Return CLOCK_MONOTONIC of this computer in nanoseconds; zero when it was switched on."""
        return self.local_ns(self._true.monotonic_ns())

    def realtime_ns(self) -> int:
        """Return the Unix time that this computer believes, in nanoseconds."""
        true_ns = self._true.monotonic_ns()
        unix_at_zero_ns = self._true.realtime_ns() - true_ns
        return unix_at_zero_ns + self._offset_ns + self.local_ns(true_ns)

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Sleep until this computer's clock shows the instant."""
        await self._true.sleep_until(self.true_ns(monotonic_ns))

    def step(self, by_ns: int) -> None:
        """Set the Unix clock, as an operator or NTP does; CLOCK_MONOTONIC goes on. Positive: forward."""
        self._offset_ns += by_ns

    def warm(self, by_ppm: float) -> None:
        """Run faster by so much from now on, in 1e-6."""
        now_ns, ppm = self._true.monotonic_ns(), self._stretches[-1].ppm + by_ppm
        self._stretches.append(_Stretch(now_ns, self.local_ns(now_ns), ppm))

    def local_ns(self, true_ns: int) -> int:
        """Return what CLOCK_MONOTONIC shows at a true time, both in nanoseconds."""
        stretch = self._stretches[-1]
        if true_ns < stretch.true_ns:  # seldom
            index = bisect_right(self._stretches, true_ns, key=itemgetter(0)) - 1
            stretch = self._stretches[max(0, index)]
        passed_ns = true_ns - stretch.true_ns
        # The product alone is rounded: times of days keep their nanoseconds.
        return stretch.local_ns + passed_ns + round(passed_ns * stretch.ppm * 1e-6)

    def true_ns(self, local_ns: int) -> int:
        """Return the first true time at which CLOCK_MONOTONIC shows at least this, both in nanoseconds."""
        stretch = self._stretches[-1]
        if local_ns < stretch.local_ns:
            index = bisect_right(self._stretches, local_ns, key=itemgetter(1)) - 1
            stretch = self._stretches[max(0, index)]
        passed_ns = local_ns - stretch.local_ns
        gained_ns = passed_ns * stretch.ppm * 1e-6 / (1 + stretch.ppm * 1e-6)
        true_ns = stretch.true_ns + passed_ns - round(gained_ns)
        while self.local_ns(true_ns) >= local_ns:
            true_ns -= 1
        while self.local_ns(true_ns) < local_ns:
            true_ns += 1
        return true_ns


RAMP_TURNS_NS = 600 * 10**9
"""How long a drift that ramps grows before it falls again: a computer warms up in the sun and cools down in a cloud."""

_RAMP_STEP_NS = 10**9


def ramped(drift_ppm: float, ramp_ppm_per_min: float, until_ns: int) -> list[tuple[int, float]]:
    """Return the steps of a drift that changes all the time, for :class:`DriftingClock`.

    Parameters
    ----------
    drift_ppm
        At the start, in 1e-6.
    ramp_ppm_per_min
        By how much it grows in a minute; after :data:`RAMP_TURNS_NS` it falls as fast, and so on.
    until_ns
        True time of the last step, in ns.
    """
    steps = []
    for from_ns in range(0, until_ns, _RAMP_STEP_NS):
        turns, since_turn_ns = divmod(from_ns + _RAMP_STEP_NS // 2, RAMP_TURNS_NS)
        grown_ns = since_turn_ns if turns % 2 == 0 else RAMP_TURNS_NS - since_turn_ns
        steps.append((from_ns, drift_ppm + ramp_ppm_per_min * grown_ns / 60e9))
    return steps


class _Stretch(NamedTuple):
    """From here on the clock runs at one rate."""

    true_ns: int
    local_ns: int
    ppm: float
