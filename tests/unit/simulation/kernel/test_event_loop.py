"""asyncio on virtual time: what takes no time, what takes exact time, and what stays real."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import threading
import time
from contextvars import ContextVar, copy_context
from typing import TYPE_CHECKING

import pytest

from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.kernel.event_loop import VirtualEventLoop

if TYPE_CHECKING:
    from pathlib import Path

HOUR_NS = 3_600_000_000_000


def test_sleep_is_exact_and_takes_no_real_time() -> None:
    """A sleep of an hour ends exactly an hour later."""
    timeline = VirtualTimeline()
    start_s = time.monotonic()
    run_virtual(lambda: asyncio.sleep(3600), timeline)
    assert timeline.now_ns() == HOUR_NS
    assert time.monotonic() - start_s < 1.0


def test_many_odd_sleeps_do_not_drift() -> None:
    """Sleeps of an odd number of nanoseconds add up exactly, also a week after the start."""
    timeline = VirtualTimeline()
    week_ns = 7 * 24 * HOUR_NS
    timeline.advance_to(week_ns)

    async def main() -> None:
        for _ in range(10_000):
            await asyncio.sleep(1_234_567e-9)

    run_virtual(main, timeline)
    assert timeline.now_ns() == week_ns + 10_000 * 1_234_567


def test_clock_reaches_every_nanosecond() -> None:
    """VirtualClock.sleep_until ends exactly at the instant."""

    async def main() -> None:
        clock = VirtualClock(0)
        for instant_ns in (1, 3, 1_000_001, 1_234_567_891, 86_400_000_000_001):
            await clock.sleep_until(instant_ns)
            assert clock.monotonic_ns() == instant_ns

    run_virtual(main)


def test_tasks_and_timeline_events_share_one_order() -> None:
    """Timers and timeline events are ordered by time, then by scheduling."""
    timeline = VirtualTimeline()
    seen: list[str] = []

    async def sleeper(name: str, delay_s: float) -> None:
        await asyncio.sleep(delay_s)
        seen.append(name)

    async def main() -> None:
        timeline.call_at(2_000_000_000, lambda: seen.append("chip 2"))
        timeline.call_at(1_500_000_000, lambda: seen.append("chip 1.5"))
        await asyncio.gather(sleeper("task 3", 3), sleeper("task 1", 1), sleeper("task 2", 2))

    run_virtual(main, timeline)
    assert seen == ["task 1", "chip 1.5", "chip 2", "task 2", "task 3"]


def test_ready_tasks_run_before_time_advances() -> None:
    """No timer fires while a task can run."""
    seen: list[str] = []

    async def busy() -> None:
        for _ in range(100):
            await asyncio.sleep(0)
        seen.append("busy")

    async def main() -> None:
        asyncio.get_running_loop().call_later(1e-9, seen.append, "timer")
        await busy()
        await asyncio.sleep(1)

    run_virtual(main)
    assert seen == ["busy", "timer"]


def test_timer_due_now_is_not_starved() -> None:
    """A timer of no delay fires although another task is always ready."""

    async def main() -> None:
        fired = asyncio.Event()
        asyncio.get_running_loop().call_later(0, fired.set)
        for _ in range(10):
            await asyncio.sleep(0)
        assert fired.is_set()

    run_virtual(main)


def test_timeline_event_wakes_a_task() -> None:
    """A timeline callback can set what a task waits for, without any timer of the loop."""
    timeline = VirtualTimeline()

    async def main() -> float:
        edge = asyncio.Event()
        timeline.call_at(123, edge.set)
        await edge.wait()
        return timeline.now_ns()

    assert run_virtual(main, timeline) == 123


def test_blocking_code_may_advance_the_time() -> None:
    """Timers that become due during a blocking call run in order after it."""
    timeline = VirtualTimeline()
    seen: list[tuple[str, int]] = []

    async def sleeper(name: str, delay_s: float) -> None:
        await asyncio.sleep(delay_s)
        seen.append((name, timeline.now_ns()))

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(sleeper("second", 2))
            group.create_task(sleeper("first", 1))
            await asyncio.sleep(0)
            timeline.advance(5_000_000_000)
            assert not seen

    run_virtual(main, timeline)
    assert seen == [("first", 5_000_000_000), ("second", 5_000_000_000)]


def test_timeouts_expire_on_time() -> None:
    """asyncio.timeout ends a wait at its virtual limit."""

    async def main() -> float:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(10):
                await asyncio.Event().wait()
        return asyncio.get_running_loop().time()

    assert run_virtual(main) == 10.0


def test_cancelled_timer_does_not_advance_time() -> None:
    """An unneeded timeout leaves nothing to jump to."""
    timeline = VirtualTimeline()

    async def main() -> None:
        async with asyncio.timeout(1000):
            await asyncio.sleep(1)
        assert timeline.next_ns() is None

    run_virtual(main, timeline)
    assert timeline.now_ns() == 1_000_000_000


def test_equal_timers_are_cancelled_individually() -> None:
    """Two timers with equal time, callback and arguments are two timers."""
    seen: list[int] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        first = loop.call_at(1.0, seen.append, 1)
        loop.call_at(1.0, seen.append, 1)
        first.cancel()
        await asyncio.sleep(2)

    run_virtual(main)
    assert seen == [1]


def test_timer_cancelled_when_due_does_not_run() -> None:
    """Of two timers due together, the first may cancel the second."""
    seen: list[str] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()

        def first() -> None:
            second.cancel()

        loop.call_at(1.0, first)
        second = loop.call_at(1.0, seen.append, "second")
        await asyncio.sleep(2)

    run_virtual(main)
    assert not seen


def test_cancelled_task_ends_at_once() -> None:
    """Cancelling a sleeping task takes no virtual time."""

    async def main() -> float:
        task = asyncio.create_task(asyncio.sleep(3600))
        await asyncio.sleep(1)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        return asyncio.get_running_loop().time()

    assert run_virtual(main) == 1.0


def test_unix_sockets_work_between_tasks(tmp_path: Path) -> None:
    """A thousand exchanges over a UNIX socket take no virtual time while timers are pending."""

    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            writer.write(line)
        writer.close()

    async def main() -> float:
        reminder = asyncio.create_task(asyncio.sleep(3600))
        async with await asyncio.start_unix_server(echo, tmp_path / "socket"):
            reader, writer = await asyncio.open_unix_connection(tmp_path / "socket")
            for number in range(1000):
                writer.write(b"%d\n" % number)
                assert await reader.readline() == b"%d\n" % number
            writer.close()
            await writer.wait_closed()
        reminder.cancel()
        return asyncio.get_running_loop().time()

    assert run_virtual(main) == 0.0


def test_time_is_frozen_during_executor_work() -> None:
    """Work in a thread takes no virtual time, so that no timeout of its caller expires."""

    async def main() -> float:
        async with asyncio.timeout(0.001):
            await asyncio.to_thread(time.sleep, 0.05)
        return asyncio.get_running_loop().time()

    assert run_virtual(main) == 0.0


def test_isolated_loop_runs_executor_work_inline() -> None:
    """Results and errors are passed on alike."""

    async def main() -> tuple[bool, float]:
        own = await asyncio.to_thread(threading.current_thread) is threading.current_thread()
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 // 0)
        return own, asyncio.get_running_loop().time()

    assert run_virtual(main, isolated=True) == (True, 0.0)


def test_cancelled_caller_of_inline_work_stays_cancelled() -> None:
    """The work is done, but its result is dropped."""
    done: list[str] = []

    async def main() -> None:
        task = asyncio.create_task(asyncio.to_thread(done.append, "work"))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_virtual(main, isolated=True)
    assert done == ["work"]


def test_isolated_loop_accepts_connections(tmp_path: Path) -> None:
    """A listening socket is served although it is polled rarely."""
    answers: list[bytes] = []

    def ask() -> None:
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(tmp_path / "socket"))
            answers.append(client.recv(10))

    async def greet(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"hello")
        writer.close()

    async def main() -> None:
        async with await asyncio.start_unix_server(greet, tmp_path / "socket"):
            client_thread = threading.Thread(target=ask)
            client_thread.start()
            while client_thread.is_alive():  # noqa: ASYNC110 (it is the passing of time that must not keep him out)
                await asyncio.sleep(1)

    run_virtual(main, isolated=True)
    assert answers == [b"hello"]


def test_loop_without_timers_blocks_on_sockets() -> None:
    """It waits in real time without spinning."""

    async def main() -> float:
        receiving, sending = os.pipe()
        readable = asyncio.Event()
        asyncio.get_running_loop().add_reader(receiving, readable.set)
        thread = threading.Timer(0.1, os.write, (sending, b"x"))
        thread.start()
        used_s = time.process_time()
        await readable.wait()
        used_s = time.process_time() - used_s
        asyncio.get_running_loop().remove_reader(receiving)
        thread.join()
        os.close(receiving)
        os.close(sending)
        return used_s

    assert run_virtual(main) < 0.05


def test_signals_are_handled() -> None:
    """add_signal_handler works while the loop waits in real time."""

    async def main() -> bool:
        asked = asyncio.Event()
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGUSR1, asked.set)
        os.kill(os.getpid(), signal.SIGUSR1)
        await asked.wait()
        return loop.remove_signal_handler(signal.SIGUSR1)

    assert run_virtual(main)


def test_exception_in_a_timeline_event_is_raised() -> None:
    """It is not swallowed."""
    timeline = VirtualTimeline()
    timeline.call_at(5, lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        run_virtual(lambda: asyncio.sleep(1), timeline)


def test_timers_of_a_closed_loop_have_no_effect() -> None:
    """A timeline outlives its loop; the loop's timers pass without a call."""
    timeline = VirtualTimeline()
    loop = VirtualEventLoop(timeline)
    loop.call_later(1, pytest.fail, "called after closing")
    loop.close()
    timeline.advance(2_000_000_000)
    assert run_virtual(lambda: asyncio.sleep(1, "later"), timeline) == "later"


def test_blocked_executor_work_continues_later() -> None:
    """It waits in virtual time, while other tasks run, and then starts again; elsewhere the call has no effect."""
    timeline = VirtualTimeline()
    done: list[str] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualEventLoop)
        loop.block_executor_work(HOUR_NS)  # not in the executor

        def write() -> None:
            loop.block_executor_work(HOUR_NS)
            done.append("written")

        writing = asyncio.create_task(asyncio.to_thread(write))
        await asyncio.sleep(60)
        done.append("a minute")
        await writing

    run_virtual(main, timeline, isolated=True)
    assert done == ["a minute", "written"]
    assert timeline.now_ns() == HOUR_NS


@pytest.mark.parametrize("sleeps", ["on the loop", "on a clock"])
def test_suspended_tasks_stand_still(sleeps: str) -> None:
    """Those of one context, their timers and wake-ups included; on resumption they run in their order."""
    suspended: ContextVar[bool] = ContextVar("suspended")
    ticks: list[float] = []

    async def tick(loop: asyncio.AbstractEventLoop) -> None:
        clock = VirtualClock(0)
        while True:
            if sleeps == "on a clock":
                await clock.sleep_until(clock.monotonic_ns() + 1_000_000_000)
            else:
                await asyncio.sleep(1.0)
            ticks.append(loop.time())

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualEventLoop)
        context = copy_context()
        context.run(suspended.set, True)
        ticking = asyncio.create_task(tick(loop), context=context)
        await asyncio.sleep(2.5)
        resume = loop.suspend(lambda context: context.get(suspended, False))
        await asyncio.sleep(10.0)
        resume()
        await asyncio.sleep(1.9)  # not at the instant of a tick
        ticking.cancel()

    run_virtual(main, isolated=True)
    assert ticks == [1.0, 2.0, 12.5, 13.5]
