"""asyncio on virtual time: an hour of sleep takes no time, sockets and threads work as ever.

All timers of the loop wait on one :class:`~tsgt.simulation.kernel.timeline.VirtualTimeline` together with the events of
the simulated hardware, in nanoseconds and in a fixed order. When no task can run and no socket is ready, time
jumps to the next event instead of passing. With nothing scheduled the loop waits for its sockets for real.

Two things take no virtual time however long they really take: work in the executor (``asyncio.to_thread``), for
which time stands still, and callbacks, unless they advance the timeline themselves as a blocking driver does. What
other processes and bare threads do takes an unforeseeable virtual time while anything is scheduled here.

A poll of the sockets costs as much as a callback or two, and most rounds have none to hear from. So a loop that is
alone, with no thread and no other process to talk to, polls in every round only while its tasks are connected with each
other; a listening socket, and the loop's own by which signals wake it, are looked at now and then.
"""

from __future__ import annotations

import asyncio
import os
import selectors
import socket
import stat
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, TypeVarTuple, Unpack

from tsgt.simulation.kernel.timeline import VirtualTimeline

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sized
    from concurrent.futures import Executor
    from contextvars import Context

    from _typeshed import FileDescriptorLike

    from tsgt.simulation.kernel.timeline import Handle

_QUIET_POLLS = 64
"""Of the polls that nobody is waiting for, one in so many is made."""

T = TypeVar("T")
Ts = TypeVarTuple("Ts")


class VirtualEventLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is a timeline's.

    Parameters
    ----------
    timeline
        What carries the time; others may schedule events on it and advance it too.
    alone
        Whether all that happens, happens in its tasks and on the timeline, as in a simulated mission. The executor then
        does its work at once, which saves the handing over to a thread, and listening sockets may wait a while. Work in
        the executor that waits for something else in the loop would wait for ever.
    """

    def __init__(self, timeline: VirtualTimeline, *, alone: bool = False) -> None:
        self._timeline = timeline
        self._alone = alone
        self._in_executor = 0
        selector = _JumpingSelector(timeline, time_stands_still=lambda: self._in_executor > 0)
        super().__init__(selector)
        selector.begin(self._ready, alone=alone)  # type: ignore[attr-defined]  # BaseEventLoop's, unknown to typeshed

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
        """Run in a thread, or at once; until it is done, time stands still."""
        if self._alone:
            return self._run_here(func, *args)
        future = super().run_in_executor(executor, func, *args)
        self._in_executor += 1
        future.add_done_callback(self._executor_done)
        return future

    def _run_here(self, func: Callable[[Unpack[Ts]], T], *args: *Ts) -> asyncio.Future[T]:
        """Do the work of the executor; the caller hears of it in the next round, as of what a thread has done."""
        future: asyncio.Future[T] = self.create_future()
        try:
            result = func(*args)
        except Exception as error:  # noqa: BLE001 (it is the caller's)
            self.call_soon(_settle, future, future.set_exception, error)
        else:
            self.call_soon(_settle, future, future.set_result, result)
        return future

    def _executor_done(self, _: asyncio.Future[Any]) -> None:
        self._in_executor -= 1

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:  # noqa: ARG002, ASYNC109
        """Wait for the executor's threads; a limit from Python 3.12 on would expire at once in virtual time."""
        self._in_executor += 1
        await super().shutdown_default_executor()
        self._in_executor -= 1


def _settle(future: asyncio.Future[Any], settle: Callable[[Any], None], outcome: object) -> None:
    if not future.done():  # cancelled meanwhile
        settle(outcome)


class _Timer(asyncio.TimerHandle):
    """A timer of the loop that waits on the timeline."""

    __slots__ = ("event",)
    event: Handle

    def cancel(self) -> None:
        """Take it off the timeline as well."""
        self.event.cancel()
        super().cancel()


def run_virtual(
    main: Callable[[], Awaitable[T]], timeline: VirtualTimeline | None = None, *, alone: bool = False
) -> T:
    """Run a coroutine function to its end on virtual time, like :func:`asyncio.run`.

    Parameters
    ----------
    main
        What to run.
    timeline
        Where time passes; None makes a new one that starts at zero.
    alone
        As for :class:`VirtualEventLoop`.
    """

    async def run() -> T:
        return await main()

    loop_factory = partial(VirtualEventLoop, timeline or VirtualTimeline(), alone=alone)
    with asyncio.Runner(loop_factory=loop_factory) as runner:
        return runner.run(run())


class _JumpingSelector(selectors.DefaultSelector):
    """A selector that lets virtual time jump where a loop would wait."""

    def __init__(self, timeline: VirtualTimeline, time_stands_still: Callable[[], bool]) -> None:
        super().__init__()
        self._timeline = timeline
        self._time_stands_still = time_stands_still
        self._ready: Sized = ()
        self._alone = False
        self._heard: set[int] = set()
        self._unpolled = 0

    def begin(self, ready: Sized, *, alone: bool) -> None:
        """Take what is registered by now, by which threads and signals wake the loop, for quiet.

        Parameters
        ----------
        ready
            What the loop has to do next.
        alone
            Whether polls that nobody in the loop waits for may be left out.
        """
        self._ready = ready
        self._alone = alone
        self._heard.clear()

    def register(
        self, fileobj: FileDescriptorLike, events: int, data: object = None
    ) -> selectors.SelectorKey:
        """Add a file, and see whether it only listens."""
        key = super().register(fileobj, events, data)
        if not _listens(key.fd):
            self._heard.add(key.fd)
        return key

    def unregister(self, fileobj: FileDescriptorLike) -> selectors.SelectorKey:
        """Take a file away."""
        key = super().unregister(fileobj)
        self._heard.discard(key.fd)
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Poll the sockets; when the loop is idle (no timeout, for it has no timers of its own) go on in time."""
        ready = self._poll()
        if timeout == 0:
            self._timeline.advance(0)
        while not (timeout == 0 or ready or self._ready):
            next_ns = self._timeline.next_ns()
            if next_ns is None or self._time_stands_still():
                return super().select()
            # What happens in the hardware alone needs no round of the loop.
            self._timeline.advance_to(next_ns)
            if not self._ready:
                ready = self._poll()
        return ready

    def _poll(self) -> list[tuple[selectors.SelectorKey, int]]:
        self._unpolled += 1
        if self._alone and not self._heard and self._unpolled < _QUIET_POLLS:
            return []
        self._unpolled = 0
        return super().select(0)


def _listens(fd: int) -> bool:
    """Whether it is a socket that waits for others to connect."""
    if not stat.S_ISSOCK(os.fstat(fd).st_mode):
        return False
    # Of whatever family it is: only the option is asked.
    with socket.fromfd(fd, socket.AF_UNIX, socket.SOCK_STREAM) as copy:
        return bool(copy.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN))
