"""Timelines on which simulated events are scheduled: virtual time for whole systems, real time for processes."""

from __future__ import annotations

import heapq
import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

# Cancelled events stay in the heap until due; they are purged when there are more than this and more than half.
_MAX_CANCELLED = 1_000


class Handle(Protocol):
    """A scheduled event."""

    def cancel(self) -> None:
        """Cancel the event; no effect if it has happened."""
        ...


class Timeline(Protocol):
    """Time and scheduling as simulated hardware sees them."""

    def now_ns(self) -> int:
        """Nanoseconds since the timeline's zero."""
        ...

    def call_at(self, at_ns: int, callback: Callable[[], object]) -> Handle:
        """Call back at a time, or as soon as possible if it has passed."""
        ...


class VirtualTimeline:
    """Virtual time from zero; it passes only through :meth:`advance` and :meth:`advance_to`."""

    def __init__(self) -> None:
        self._now_ns = 0
        self._scheduled = 0
        self._cancelled = 0
        self._heap: list[tuple[int, int, _Event]] = []

    def now_ns(self) -> int:
        """Nanoseconds since the start."""
        return self._now_ns

    def call_at(self, at_ns: int, callback: Callable[[], object]) -> Handle:
        """Call back at an instant; events of the same instant keep their scheduling order.

        An instant in the past counts as now; an event for now is due at the next advance, even one of zero length.
        """
        event = _Event(callback, self)
        self._scheduled += 1
        if at_ns < self._now_ns:
            at_ns = self._now_ns
        heapq.heappush(self._heap, (at_ns, self._scheduled, event))
        return event

    def next_ns(self) -> int | None:
        """Return when the next event is due; None: nothing is scheduled."""
        heap = self._heap
        while heap and heap[0][2].callback is None:
            heapq.heappop(heap)
            self._cancelled -= 1
        return heap[0][0] if heap else None

    def call_due(self) -> None:
        """Make the callbacks that are due now."""
        if self._heap and self._heap[0][0] <= self._now_ns:
            self.advance_to(self._now_ns)

    def call_next(self) -> bool:
        """Advance to the next event and make all callbacks of its instant; return whether there was one."""
        next_ns = self.next_ns()
        if next_ns is not None:
            self.advance_to(next_ns)
        return next_ns is not None

    def advance(self, duration_ns: int) -> None:
        """Advance by a duration."""
        self.advance_to(self._now_ns + duration_ns)

    def advance_to(self, until_ns: int) -> None:
        """Advance to an instant and make the callbacks that are due, each at its time.

        Time never runs backwards: for an instant in the past, only events that are due now are called. A callback may itself
        advance the time; the events it skips are called on the way.
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

    def _purge_cancelled(self) -> None:
        """Remove cancelled events when they dominate the heap, so that unexpired timeouts do not accumulate."""
        self._cancelled += 1
        if self._cancelled > max(_MAX_CANCELLED, len(self._heap) // 2):
            self._heap[:] = [entry for entry in self._heap if entry[2].callback is not None]
            heapq.heapify(self._heap)
            self._cancelled = 0


class _Event:
    """A scheduled call; the callback is None once it has been made or cancelled."""

    __slots__ = ("_timeline", "callback")

    def __init__(self, callback: Callable[[], object], timeline: VirtualTimeline) -> None:
        self.callback: Callable[[], object] | None = callback
        self._timeline = timeline

    def cancel(self) -> None:
        """Cancel the call."""
        if self.callback is not None:
            self.callback = None
            self._timeline._purge_cancelled()  # noqa: SLF001 (the timeline's own event)


class LoopTimeline:
    """CLOCK_MONOTONIC on an asyncio loop in real time, for simulated hardware in real processes.

    Callbacks may be late: a millisecond, as loop timers are, or more on a busy computer. Their time is the one that they
    were scheduled for, so that delays do not add up over a chain of events; an event that needs an exact time must carry it.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._scheduled_ns: int | None = None
        self._latest_ns = 0

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC in nanoseconds, in a callback when it should have been called; never goes back."""
        now_ns = time.monotonic_ns() if self._scheduled_ns is None else self._scheduled_ns
        self._latest_ns = max(self._latest_ns, now_ns)
        return self._latest_ns

    def call_at(self, at_ns: int, callback: Callable[[], object]) -> Handle:
        """Call back in the loop's thread."""

        def call() -> None:
            self._scheduled_ns = at_ns
            try:
                callback()
            finally:
                self._scheduled_ns = None

        return self._loop.call_later(max(0, at_ns - time.monotonic_ns()) / 1e9, call)
