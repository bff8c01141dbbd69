"""Timelines: order, jumps and cancellation, in virtual and in real time."""

from __future__ import annotations

import asyncio
import time
from functools import partial

from tsgt.simulation.kernel import LoopTimeline, VirtualTimeline


def test_scheduling_does_not_advance_time() -> None:
    """Only advancing does."""
    timeline = VirtualTimeline()
    timeline.call_at(5, lambda: None)
    assert timeline.now_ns() == 0
    assert timeline.next_ns() == 5


def test_events_are_ordered_by_time_then_by_scheduling() -> None:
    """Of two events at one instant, the first scheduled is called first."""
    timeline = VirtualTimeline()
    seen: list[str] = []
    for at_ns, name in ((20, "c"), (10, "a"), (20, "d"), (10, "b")):
        timeline.call_at(at_ns, partial(seen.append, name))
    timeline.advance_to(20)
    assert seen == ["a", "b", "c", "d"]


def test_callback_runs_at_its_time() -> None:
    """Afterwards time is at the end of the advance."""
    timeline = VirtualTimeline()
    seen: list[int] = []
    for at_ns in (3, 7):
        timeline.call_at(at_ns, lambda: seen.append(timeline.now_ns()))
    timeline.advance(10)
    assert seen == [3, 7]
    assert timeline.now_ns() == 10


def test_event_after_the_advance_waits() -> None:
    """It is called by a later advance."""
    timeline = VirtualTimeline()
    seen: list[int] = []
    timeline.call_at(11, lambda: seen.append(timeline.now_ns()))
    timeline.advance_to(10)
    assert not seen
    timeline.advance(1)
    assert seen == [11]


def test_event_may_schedule_another_within_the_same_advance() -> None:
    """A chain of events is called in one advance, each at its own time."""
    timeline = VirtualTimeline()
    seen: list[int] = []

    def tick() -> None:
        seen.append(timeline.now_ns())
        timeline.call_at(timeline.now_ns() + 10, tick)

    timeline.call_at(10, tick)
    timeline.advance_to(45)
    assert seen == [10, 20, 30, 40]


def test_event_in_the_past_is_due_now() -> None:
    """It is called by the next advance, and time does not run backwards."""
    timeline = VirtualTimeline()
    timeline.advance_to(100)
    seen: list[int] = []
    timeline.call_at(50, lambda: seen.append(timeline.now_ns()))
    assert timeline.next_ns() == 100
    timeline.advance_to(60)
    assert seen == [100]
    assert timeline.now_ns() == 100


def test_cancelled_event_is_not_called() -> None:
    """Cancelling after the call has no effect."""
    timeline = VirtualTimeline()
    seen: list[str] = []
    cancelled = timeline.call_at(5, partial(seen.append, "cancelled"))
    kept = timeline.call_at(6, partial(seen.append, "kept"))
    cancelled.cancel()
    cancelled.cancel()
    assert timeline.next_ns() == 6
    timeline.advance_to(10)
    kept.cancel()
    assert seen == ["kept"]
    assert timeline.next_ns() is None


def test_callback_may_advance_the_time() -> None:
    """Events skipped by a blocking callback are called, and the outer advance continues from there."""
    timeline = VirtualTimeline()
    seen: list[tuple[str, int]] = []

    def blocking() -> None:
        timeline.advance(100)
        seen.append(("blocking", timeline.now_ns()))

    timeline.call_at(10, blocking)
    timeline.call_at(50, lambda: seen.append(("other", timeline.now_ns())))
    timeline.advance_to(20)
    assert seen == [("other", 50), ("blocking", 110)]
    assert timeline.now_ns() == 110


def test_cancelled_events_are_purged() -> None:
    """Many unexpired timeouts leave the heap small and the order intact."""
    timeline = VirtualTimeline()
    seen: list[int] = []
    timeline.call_at(7, lambda: seen.append(7))
    for _ in range(100_000):
        timeline.call_at(3_600_000_000_000, lambda: seen.append(-1)).cancel()
    timeline.call_at(5, lambda: seen.append(5))
    assert len(timeline._heap) < 5_000
    timeline.advance_to(4_000_000_000_000)
    assert seen == [5, 7]


def test_loop_timeline_in_real_time() -> None:
    """Callbacks are never early, and cancelled ones are not called."""

    async def main() -> None:
        timeline = LoopTimeline(asyncio.get_running_loop())
        start_ns = timeline.now_ns()
        assert abs(start_ns - time.monotonic_ns()) < 1_000_000_000
        reached: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        timeline.call_at(start_ns, reached.cancel).cancel()
        timeline.call_at(start_ns + 5_000_000, lambda: reached.set_result(timeline.now_ns()))
        assert await reached >= start_ns + 5_000_000 - 1_000

    asyncio.run(main())


def test_late_callbacks_have_the_time_they_were_scheduled_for() -> None:
    """A loop that is busy does not slow a chain of events down, and time does not go back."""

    async def main() -> None:
        timeline = LoopTimeline(asyncio.get_running_loop())
        start_ns = timeline.now_ns()
        seen: list[int] = []
        done = asyncio.Event()

        def second() -> None:
            seen.append(timeline.now_ns() - start_ns)
            done.set()

        def first() -> None:
            seen.append(timeline.now_ns() - start_ns)
            timeline.call_at(timeline.now_ns() + 2_000_000, second)

        timeline.call_at(start_ns + 1_000_000, first)
        time.sleep(0.02)  # noqa: ASYNC251 (the loop is busy)
        await done.wait()
        assert seen == [1_000_000, 3_000_000]
        after_ns = timeline.now_ns()
        assert after_ns - start_ns > 20_000_000
        timeline.call_at(start_ns, lambda: seen.append(timeline.now_ns()))
        await asyncio.sleep(0.001)
        assert seen[-1] == after_ns

    asyncio.run(main())
