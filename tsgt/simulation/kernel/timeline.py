"""Where simulated events wait for their time: virtual time for whole systems, real time for processes."""

from __future__ import annotations

import heapq
import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

# Cancelled events stay in the heap until their time comes; more than these many, and more than half, are swept.
_CANCELLED_KEPT = 1_000


class Handle(Protocol):
    """An event that has been scheduled."""

    def cancel(self) -> None:
        """Let it not happen; nothing changes when it already has."""
        ...


class Timeline(Protocol):
    """What simulated hardware knows of time."""

    def now_ns(self) -> int:
        """Nanoseconds since the timeline's zero."""
        ...

    def call_at(self, at_ns: int, callback: Callable[[], object]) -> Handle:
        """Call back at that time, as soon as possible when it has passed."""
        ...


class VirtualTimeline:
    """Time that passes only when told to, from event to event; it starts at zero."""

    def __init__(self) -> None:
        self._now_ns = 0
        self._scheduled = 0
        self._cancelled = 0
        self._heap: list[tuple[int, int, _Event]] = []

    def now_ns(self) -> int:
        """Nanoseconds since the start."""
        return self._now_ns

    def call_at(self, at_ns: int, callback: Callable[[], object]) -> Handle:
        """Call back when time reaches the given instant; events of one instant keep their order of scheduling.

        An instant in the past counts as now, and now comes with the next advance, even one of no length.
        """
        event = _Event(callback, self)
        self._scheduled += 1
        heapq.heappush(self._heap, (max(at_ns, self._now_ns), self._scheduled, event))
        return event

    def next_ns(self) -> int | None:
        """When the next event is due; None if nothing is scheduled."""
        heap = self._heap
        while heap and heap[0][2].callback is None:
            heapq.heappop(heap)
            self._cancelled -= 1
        return heap[0][0] if heap else None

    def advance(self, duration_ns: int) -> None:
        """Let that much time pass."""
        self.advance_to(self._now_ns + duration_ns)

    def advance_to(self, until_ns: int) -> None:
        """Let time pass until the given instant and call back what is due, at its time.

        Time never runs backwards: until an instant in the past, only what is due now is called. A callback may
        itself advance the time; what it jumps over is called on the way.
        """
        heap = self._heap
        if until_ns < self._now_ns:
            until_ns = self._now_ns
        while heap and heap[0][0] <= until_ns:
            at_ns, _, event = heapq.heappop(heap)
            callback = event.callback
            if callback is None:
                self._cancelled -= 1
                continue
            event.callback = None
            if at_ns > self._now_ns:
                self._now_ns = at_ns
            callback()
        if until_ns > self._now_ns:
            self._now_ns = until_ns

    def _sweep(self) -> None:
        """Forget cancelled events, so that time-outs which never expire do not pile up."""
        self._cancelled += 1
        if self._cancelled > max(_CANCELLED_KEPT, len(self._heap) // 2):
            self._heap[:] = [entry for entry in self._heap if entry[2].callback is not None]
            heapq.heapify(self._heap)
            self._cancelled = 0


class _Event:
    """One call on a virtual timeline; the callback is None once it has been made or cancelled."""

    __slots__ = ("_timeline", "callback")

    def __init__(self, callback: Callable[[], object], timeline: VirtualTimeline) -> None:
        self.callback: Callable[[], object] | None = callback
        self._timeline = timeline

    def cancel(self) -> None:
        """Let it not happen."""
        if self.callback is not None:
            self.callback = None
            self._timeline._sweep()  # noqa: SLF001 (the timeline's own event)


class LoopTimeline:
    """CLOCK_MONOTONIC on an asyncio loop in real time, for simulated hardware in real processes.

    Callbacks come up to a millisecond late, as timers of a loop do; what happens at an exact time must carry it.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC in nanoseconds."""
        return time.monotonic_ns()

    def call_at(self, at_ns: int, callback: Callable[[], object]) -> Handle:
        """Call back in the loop's thread."""
        return self._loop.call_later(max(0, at_ns - self.now_ns()) / 1e9, callback)
