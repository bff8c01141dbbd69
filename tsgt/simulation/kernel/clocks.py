"""Simulated clocks: true time, and the clocks of computers with offset and drift."""

from __future__ import annotations

import asyncio
from bisect import bisect_right
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple, Protocol

from tsgt.clock import Clock
from tsgt.simulation.kernel.event_loop import VirtualEventLoop

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tsgt.simulation.kernel.timeline import Timeline


class SimulatedClock(Clock, Protocol):
    """A clock that can convert between its own and the true time, to timestamp events of simulated hardware."""

    def local_ns(self, true_ns: int) -> int:
        """Return the reading of :meth:`monotonic_ns` at a true time, both in ns."""
        ...

    def true_ns(self, local_ns: int) -> int:
        """Return the first true time at which :meth:`monotonic_ns` reads at least this, both in ns."""
        ...


class VirtualClock:
    """The time of the running event loop, used as true time; ``timeline``: that of this loop, if it is known already."""

    def __init__(self, unix_at_zero_ns: int, timeline: Timeline | None = None) -> None:
        self._unix_at_zero_ns = unix_at_zero_ns
        if timeline is not None:
            self.monotonic_ns = timeline.now_ns  # type: ignore[method-assign]  # it is read in every other callback

    def monotonic_ns(self) -> int:
        """Return the loop's time in ns."""
        return round(asyncio.get_running_loop().time() * 1e9)

    def realtime_ns(self) -> int:
        """Return the Unix time in ns."""
        return self._unix_at_zero_ns + self.monotonic_ns()

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Sleep until an instant; yields to other tasks at least once."""
        loop, duration_ns = asyncio.get_running_loop(), monotonic_ns - self.monotonic_ns()
        if duration_ns > 0 and isinstance(loop, VirtualEventLoop):
            await loop.sleep_until_ns(monotonic_ns)
        else:
            await asyncio.sleep(max(0, duration_ns) / 1e9)

    def step(self, by_ns: int) -> None:
        """Step the Unix clock; positive: forward. CLOCK_MONOTONIC is unaffected."""
        self._unix_at_zero_ns += by_ns

    def local_ns(self, true_ns: int) -> int:
        """Return ``true_ns``."""
        return true_ns

    def true_ns(self, local_ns: int) -> int:
        """Return ``local_ns``."""
        return local_ns


class DriftingClock:
    """Clock of another computer: its own Unix time, and a crystal with a frequency offset.

    Parameters
    ----------
    true
        True time.
    offset_ns
        Unix clock minus true Unix time at true zero, in ns; positive: this clock is ahead.
    drift_ppm
        Frequency offset in 1e-6; positive: this clock gains.
    drift_changes
        Later frequency offsets: true time in ns from which each applies, offset in 1e-6. In any order.
    booted_ns
        True time at which the computer was switched on, in ns.
    """

    def __init__(
        self,
        true: Clock,
        *,
        offset_ns: int = 0,
        drift_ppm: float = 0.0,
        drift_changes: Iterable[tuple[int, float]] = (),
        booted_ns: int = 0,
    ) -> None:
        self._true = true
        self._offset_ns = offset_ns
        self._resumes_with_ppm: float | None = None  # None: not suspended
        steps = sorted(drift_changes)
        self._segments = [
            _RateSegment(
                booted_ns, 0, max((s for s in steps if s[0] <= booted_ns), default=(0, drift_ppm))[1]
            )
        ]
        for from_ns, ppm in steps:
            if from_ns > booted_ns:
                self._segments.append(_RateSegment(from_ns, self.local_ns(from_ns), ppm))

    def monotonic_ns(self) -> int:
        """Return CLOCK_MONOTONIC in ns; zero at power-on."""
        return self.local_ns(self._true.monotonic_ns())

    def realtime_ns(self) -> int:
        """Return this computer's Unix time in ns."""
        true_ns = self._true.monotonic_ns()
        unix_at_zero_ns = self._true.realtime_ns() - true_ns
        return unix_at_zero_ns + self._offset_ns + self.local_ns(true_ns)

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Sleep until this clock reads the instant."""
        await self._true.sleep_until(self.true_ns(monotonic_ns))

    def step(self, by_ns: int) -> None:
        """Step the Unix clock; positive: forward. CLOCK_MONOTONIC is unaffected."""
        self._offset_ns += by_ns

    def change_drift(self, by_ppm: float) -> None:
        """Increase the frequency offset by ``by_ppm`` from now on."""
        if self._resumes_with_ppm is not None:
            self._resumes_with_ppm += by_ppm
            return
        now_ns, ppm = self._true.monotonic_ns(), self._segments[-1].ppm + by_ppm
        self._segments.append(_RateSegment(now_ns, self.local_ns(now_ns), ppm))

    def suspend(self) -> Callable[[], None]:
        """Stop CLOCK_MONOTONIC, as the suspension of a computer does; return what lets it run on. The Unix clock is kept by hardware."""
        suspended_ns, self._resumes_with_ppm = self._true.monotonic_ns(), self._segments[-1].ppm
        self._segments.append(_RateSegment(suspended_ns, self.local_ns(suspended_ns), _SUSPENDED_PPM))

        def resume() -> None:
            resumed_ns = self._true.monotonic_ns()
            ppm, self._resumes_with_ppm = self._resumes_with_ppm or 0.0, None
            self._segments.append(_RateSegment(resumed_ns, self.local_ns(resumed_ns) + 1, ppm))
            self.step(resumed_ns - suspended_ns)

        return resume

    def local_ns(self, true_ns: int) -> int:
        """Return the reading of CLOCK_MONOTONIC at a true time, both in ns."""
        segment = self._segments[-1]
        if true_ns < segment.true_ns:  # rare
            index = bisect_right(self._segments, true_ns, key=itemgetter(0)) - 1
            segment = self._segments[max(0, index)]
        elapsed_ns = true_ns - segment.true_ns
        # Only the product is rounded, so that times of many days stay exact to the nanosecond.
        return segment.local_ns + elapsed_ns + round(elapsed_ns * segment.ppm * 1e-6)

    def true_ns(self, local_ns: int) -> int:
        """Return the first true time at which CLOCK_MONOTONIC reads at least this, both in ns."""
        segment = self._segments[-1]
        if local_ns < segment.local_ns:
            index = bisect_right(self._segments, local_ns, key=itemgetter(1)) - 1
            segment = self._segments[max(0, index)]
        elapsed_ns = local_ns - segment.local_ns
        if segment.ppm == _SUSPENDED_PPM:
            return segment.true_ns + elapsed_ns * 1_000_000
        ppm = segment.ppm
        since_ns = elapsed_ns - round(elapsed_ns * ppm * 1e-6 / (1 + ppm * 1e-6))
        if segment is self._segments[-1]:  # nearly always: the same search, without one for the segment
            while since_ns > 0 and since_ns + round(since_ns * ppm * 1e-6) >= elapsed_ns:
                since_ns -= 1
            while since_ns + round(since_ns * ppm * 1e-6) < elapsed_ns:
                since_ns += 1
            if since_ns > 0:
                return segment.true_ns + since_ns
        true_ns = segment.true_ns + since_ns
        while self.local_ns(true_ns) >= local_ns:
            true_ns -= 1
        while self.local_ns(true_ns) < local_ns:
            true_ns += 1
        return true_ns


_SUSPENDED_PPM = -999_999.0  # a microsecond per second: a clock that stands still has no inverse

RAMP_HALF_PERIOD_NS = 600 * 10**9
"""A drift ramp rises for this time, then falls for as long: a computer that warms up and cools down."""

_RAMP_STEP_NS = 10**9


def drift_ramp(drift_ppm: float, ramp_ppm_per_min: float, until_ns: int) -> list[tuple[int, float]]:
    """Return the drift changes of a triangular drift ramp until a true time, for :class:`DriftingClock`.

    The slope's sign alternates after each :data:`RAMP_HALF_PERIOD_NS`.
    """
    steps = []
    for from_ns in range(0, until_ns, _RAMP_STEP_NS):
        turns, since_turn_ns = divmod(from_ns + _RAMP_STEP_NS // 2, RAMP_HALF_PERIOD_NS)
        grown_ns = since_turn_ns if turns % 2 == 0 else RAMP_HALF_PERIOD_NS - since_turn_ns
        steps.append((from_ns, drift_ppm + ramp_ppm_per_min * grown_ns / 60e9))
    return steps


class _RateSegment(NamedTuple):
    """Interval of constant rate, by its start."""

    true_ns: int
    local_ns: int
    ppm: float
