"""Virtual time: order, jumps, cancellation; and the same events in real time."""

from __future__ import annotations

import asyncio
import time
from functools import partial

from tsgt.simulation.kernel import LoopTimeline, VirtualTimeline


def test_time_stands_still_by_itself() -> None:
    """Scheduling moves nothing; only advancing does."""
    timeline = VirtualTimeline()
    timeline.call_at(5, lambda: None)
    assert timeline.now_ns() == 0
    assert timeline.next_ns() == 5


def test_events_come_in_order_of_time_then_of_scheduling() -> None:
    """The earlier event comes first, and of two at one instant the one scheduled first."""
    timeline = VirtualTimeline()
    seen: list[str] = []
    for at_ns, name in ((20, "c"), (10, "a"), (20, "d"), (10, "b")):
        timeline.call_at(at_ns, partial(seen.append, name))
    timeline.advance_to(20)
    assert seen == ["a", "b", "c", "d"]


def test_an_event_sees_its_own_time() -> None:
    """A callback is called at its instant, and afterwards time is where it was told to be."""
    timeline = VirtualTimeline()
    seen: list[int] = []
    for at_ns in (3, 7):
        timeline.call_at(at_ns, lambda: seen.append(timeline.now_ns()))
    timeline.advance(10)
    assert seen == [3, 7]
    assert timeline.now_ns() == 10


def test_what_is_not_due_stays() -> None:
    """An event after the end of the advance waits for the next one."""
    timeline = VirtualTimeline()
    seen: list[int] = []
    timeline.call_at(11, lambda: seen.append(timeline.now_ns()))
    timeline.advance_to(10)
    assert not seen
    timeline.advance(1)
    assert seen == [11]


def test_an_event_schedules_another_within_the_same_advance() -> None:
    """A chain of events runs through in one advance, each at its own time."""
    timeline = VirtualTimeline()
    seen: list[int] = []

    def tick() -> None:
        seen.append(timeline.now_ns())
        timeline.call_at(timeline.now_ns() + 10, tick)

    timeline.call_at(10, tick)
    timeline.advance_to(45)
    assert seen == [10, 20, 30, 40]


def test_the_past_counts_as_now() -> None:
    """An event for an instant that has passed comes with the next advance, and time does not run back."""
    timeline = VirtualTimeline()
    timeline.advance_to(100)
    seen: list[int] = []
    timeline.call_at(50, lambda: seen.append(timeline.now_ns()))
    assert timeline.next_ns() == 100
    timeline.advance_to(60)
    assert seen == [100]
    assert timeline.now_ns() == 100


def test_a_cancelled_event_does_not_come() -> None:
    """Cancelling works before the event, and afterwards does nothing."""
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


def test_a_callback_may_advance_the_time_itself() -> None:
    """What a blocking callback jumps over is called on the way, and the outer advance goes on from there."""
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


def test_cancelled_events_do_not_pile_up() -> None:
    """A million time-outs that never expire leave the heap small and the rest in order."""
    timeline = VirtualTimeline()
    seen: list[int] = []
    timeline.call_at(7, lambda: seen.append(7))
    for _ in range(100_000):
        timeline.call_at(3_600_000_000_000, lambda: seen.append(-1)).cancel()
    timeline.call_at(5, lambda: seen.append(5))
    assert len(timeline._heap) < 5_000
    timeline.advance_to(4_000_000_000_000)
    assert seen == [5, 7]


def test_real_time_on_a_loop() -> None:
    """The same calls work on CLOCK_MONOTONIC: not before their time, and cancelled ones never."""

    async def main() -> None:
        timeline = LoopTimeline(asyncio.get_running_loop())
        began_ns = timeline.now_ns()
        assert abs(began_ns - time.monotonic_ns()) < 1_000_000_000
        reached: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        timeline.call_at(began_ns, reached.cancel).cancel()
        timeline.call_at(began_ns + 5_000_000, lambda: reached.set_result(timeline.now_ns()))
        assert await reached >= began_ns + 5_000_000 - 1_000

    asyncio.run(main())
