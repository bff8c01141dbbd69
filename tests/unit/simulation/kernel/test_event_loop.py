"""asyncio on virtual time: what takes no time, what takes its exact time, and what still is real."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import threading
import time
from typing import TYPE_CHECKING

import pytest

from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.kernel.event_loop import VirtualEventLoop

if TYPE_CHECKING:
    from pathlib import Path

HOUR_NS = 3_600_000_000_000


def test_an_hour_takes_no_time_and_is_exact() -> None:
    """A sleep of an hour ends exactly an hour later and at once for the caller."""
    timeline = VirtualTimeline()
    began_s = time.monotonic()
    run_virtual(lambda: asyncio.sleep(3600), timeline)
    assert timeline.now_ns() == HOUR_NS
    assert time.monotonic() - began_s < 1.0


def test_a_million_odd_sleeps_do_not_drift() -> None:
    """Sleeps of an odd number of nanoseconds add up exactly, also a week after the start."""
    timeline = VirtualTimeline()
    week_ns = 7 * 24 * HOUR_NS
    timeline.advance_to(week_ns)

    async def main() -> None:
        for _ in range(10_000):
            await asyncio.sleep(1_234_567e-9)

    run_virtual(main, timeline)
    assert timeline.now_ns() == week_ns + 10_000 * 1_234_567


def test_the_clock_reaches_every_nanosecond() -> None:
    """VirtualClock.sleep_until ends exactly at the instant asked for."""

    async def main() -> None:
        clock = VirtualClock(0)
        for instant_ns in (1, 3, 1_000_001, 1_234_567_891, 86_400_000_000_001):
            await clock.sleep_until(instant_ns)
            assert clock.monotonic_ns() == instant_ns

    run_virtual(main)


def test_tasks_and_hardware_share_one_order() -> None:
    """Timers of tasks and events of the timeline come by time, and by scheduling when the time is the same."""
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


def test_ready_tasks_run_before_time_moves() -> None:
    """As long as a task can run, no timer fires."""
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


def test_a_timer_due_now_is_not_starved() -> None:
    """A timer of no delay fires although another task is always ready to run."""

    async def main() -> None:
        fired = asyncio.Event()
        asyncio.get_running_loop().call_later(0, fired.set)
        for _ in range(10):
            await asyncio.sleep(0)
        assert fired.is_set()

    run_virtual(main)


def test_a_hardware_event_wakes_a_task() -> None:
    """A callback of the timeline can set what a task waits for, without any timer of the loop."""
    timeline = VirtualTimeline()

    async def main() -> float:
        edge = asyncio.Event()
        timeline.call_at(123, edge.set)
        await edge.wait()
        return timeline.now_ns()

    assert run_virtual(main, timeline) == 123


def test_blocking_code_may_advance_the_time() -> None:
    """A blocking call that advances the timeline lets timers fall due, which run in order after it."""
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
    """asyncio.timeout cuts a wait at its virtual limit."""

    async def main() -> float:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(10):
                await asyncio.Event().wait()
        return asyncio.get_running_loop().time()

    assert run_virtual(main) == 10.0


def test_a_cancelled_timer_does_not_move_time() -> None:
    """A time-out that was not needed leaves nothing that time would jump to."""
    timeline = VirtualTimeline()

    async def main() -> None:
        async with asyncio.timeout(1000):
            await asyncio.sleep(1)
        assert timeline.next_ns() is None

    run_virtual(main, timeline)
    assert timeline.now_ns() == 1_000_000_000


def test_equal_timers_are_cancelled_one_by_one() -> None:
    """Two timers alike in time, callback and arguments are two timers."""
    seen: list[int] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        first = loop.call_at(1.0, seen.append, 1)
        loop.call_at(1.0, seen.append, 1)
        first.cancel()
        await asyncio.sleep(2)

    run_virtual(main)
    assert seen == [1]


def test_a_timer_cancelled_in_the_instant_it_is_due_does_not_run() -> None:
    """Of two timers due together, the first may still cancel the second."""
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


def test_a_cancelled_task_ends_at_once() -> None:
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
    """A thousand exchanges over a real UNIX socket take no virtual time while timers are pending."""

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


def test_time_stands_still_for_threads() -> None:
    """Work in a thread takes no virtual time, however long it takes, so that no time-out of its caller expires."""

    async def main() -> float:
        async with asyncio.timeout(0.001):
            await asyncio.to_thread(time.sleep, 0.05)
        return asyncio.get_running_loop().time()

    assert run_virtual(main) == 0.0


def test_alone_work_is_done_at_once() -> None:
    """A loop that is alone does the executor's work in its own, and hands over result and error alike."""

    async def main() -> tuple[bool, float]:
        own = await asyncio.to_thread(threading.current_thread) is threading.current_thread()
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 // 0)
        return own, asyncio.get_running_loop().time()

    assert run_virtual(main, isolated=True) == (True, 0.0)


def test_alone_a_cancelled_caller_hears_nothing() -> None:
    """The executor's work is done, but whoever was cancelled while it waited for it ends as cancelled."""
    done: list[str] = []

    async def main() -> None:
        task = asyncio.create_task(asyncio.to_thread(done.append, "work"))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_virtual(main, isolated=True)
    assert done == ["work"]


def test_a_stranger_is_let_in_while_time_passes(tmp_path: Path) -> None:
    """A listening socket, which not every round asks, is still answered while timers keep the loop from waiting."""
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
            interferer_radio = threading.Thread(target=ask)
            interferer_radio.start()
            while interferer_radio.is_alive():  # noqa: ASYNC110 (it is the passing of time that must not keep him out)
                await asyncio.sleep(1)

    run_virtual(main, isolated=True)
    assert answers == [b"hello"]


def test_nothing_scheduled_waits_for_a_socket_for_real() -> None:
    """With no timer anywhere the loop sleeps until the socket has something to read, without spinning."""

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
    """add_signal_handler works while the loop waits for real."""

    async def main() -> bool:
        asked = asyncio.Event()
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGUSR1, asked.set)
        os.kill(os.getpid(), signal.SIGUSR1)
        await asked.wait()
        return loop.remove_signal_handler(signal.SIGUSR1)

    assert run_virtual(main)


def test_an_error_in_the_hardware_ends_the_run() -> None:
    """An exception in an event of the timeline is not swallowed."""
    timeline = VirtualTimeline()
    timeline.call_at(5, lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        run_virtual(lambda: asyncio.sleep(1), timeline)


def test_timers_of_a_closed_loop_are_forgotten() -> None:
    """A timeline outlives its loop: what the loop had scheduled passes without harm."""
    timeline = VirtualTimeline()
    loop = VirtualEventLoop(timeline)
    loop.call_later(1, pytest.fail, "called after closing")
    loop.close()
    timeline.advance(2_000_000_000)
    assert run_virtual(lambda: asyncio.sleep(1, "later"), timeline) == "later"
