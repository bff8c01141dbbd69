"""asyncio on virtual time: an hour of sleep takes no time, sockets and threads work as ever.

All timers of the loop wait on one :class:`~tsgt.simulation.timeline.VirtualTimeline` together with the events of
the simulated hardware, in nanoseconds and in a fixed order. When no task can run and no socket is ready, time
jumps to the next event instead of passing. With nothing scheduled the loop waits for its sockets for real.

Two things take no virtual time however long they really take: work in the executor (``asyncio.to_thread``), for
which time stands still, and callbacks, unless they advance the timeline themselves as a blocking driver does. What
other processes and bare threads do takes an unforeseeable virtual time while anything is scheduled here.
"""

from __future__ import annotations

import asyncio
import selectors
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, TypeVarTuple, Unpack

from tsgt.simulation.timeline import VirtualTimeline

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from concurrent.futures import Executor
    from contextvars import Context

    from tsgt.simulation.timeline import Handle

T = TypeVar("T")
Ts = TypeVarTuple("Ts")


class VirtualEventLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is a timeline's.

    Parameters
    ----------
    timeline
        What carries the time; others may schedule events on it and advance it too.
    """

    def __init__(self, timeline: VirtualTimeline) -> None:
        self._timeline = timeline
        self._in_executor = 0
        super().__init__(_JumpingSelector(timeline, time_stands_still=lambda: self._in_executor > 0))

    def time(self) -> float:
        """Seconds since the timeline's zero; exact to the nanosecond for the first twenty-six days."""
        return self._timeline.now_ns() / 1e9

    def call_at(
        self,
        when: float,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        """Schedule on the timeline, where the order of all events is decided, not in the loop's own queue."""
        timer = _Timer(when, callback, args, self, context)
        timer.event = self._timeline.call_at(round(when * 1e9), partial(self._due, timer))
        return timer

    def _due(self, timer: asyncio.TimerHandle) -> None:
        if not self.is_closed():
            self._add_callback(timer)  # type: ignore[attr-defined]  # BaseEventLoop's, unknown to typeshed

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[Unpack[Ts]], T], *args: *Ts
    ) -> asyncio.Future[T]:
        """Run in a thread; until it is done, time stands still."""
        future = super().run_in_executor(executor, func, *args)
        self._in_executor += 1
        future.add_done_callback(self._executor_done)
        return future

    def _executor_done(self, _: asyncio.Future[Any]) -> None:
        self._in_executor -= 1

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:  # noqa: ARG002, ASYNC109
        """Wait for the executor's threads; a limit from Python 3.12 on would expire at once in virtual time."""
        self._in_executor += 1
        await super().shutdown_default_executor()
        self._in_executor -= 1


class _Timer(asyncio.TimerHandle):
    """A timer of the loop that waits on the timeline."""

    __slots__ = ("event",)
    event: Handle

    def cancel(self) -> None:
        """Take it off the timeline as well."""
        self.event.cancel()
        super().cancel()


def run_virtual(main: Callable[[], Awaitable[T]], timeline: VirtualTimeline | None = None) -> T:
    """Run a coroutine function to its end on virtual time, like :func:`asyncio.run`.

    Parameters
    ----------
    main
        What to run.
    timeline
        Where time passes; None makes a new one that starts at zero.
    """

    async def run() -> T:
        return await main()

    with asyncio.Runner(loop_factory=partial(VirtualEventLoop, timeline or VirtualTimeline())) as runner:
        return runner.run(run())


class _JumpingSelector(selectors.DefaultSelector):
    """A selector that lets virtual time jump where a loop would wait."""

    def __init__(self, timeline: VirtualTimeline, time_stands_still: Callable[[], bool]) -> None:
        super().__init__()
        self._timeline = timeline
        self._time_stands_still = time_stands_still

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Poll the sockets; when the loop is idle (no timeout, for it has no timers of its own) go on in time."""
        ready = super().select(0)
        if timeout == 0:
            self._timeline.advance(0)
        elif not ready:
            next_ns = self._timeline.next_ns()
            if next_ns is None or self._time_stands_still():
                return super().select()
            self._timeline.advance_to(next_ns)
        return ready
