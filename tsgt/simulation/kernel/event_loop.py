"""asyncio on virtual time: sleeps take no real time; sockets and threads work as usual.

All timers of the loop wait on one :class:`~tsgt.simulation.kernel.timeline.VirtualTimeline` together with the events of
the simulated hardware, in nanoseconds and in a fixed order. When no task can run and no socket is ready, time jumps to
the next event. With nothing scheduled, the loop blocks on its sockets in real time.

Two things take no virtual time: work in the executor (``asyncio.to_thread``), during which time is frozen, and
callbacks, unless they advance the timeline as a blocking driver does. Work of other processes and threads takes an
unpredictable virtual time while events are scheduled.

Polling sockets costs as much as one or two callbacks. An isolated loop, without threads or other processes, polls in
every round only while its tasks have connections; listening sockets and the loop's wake-up socket are polled every
``_IDLE_POLL_INTERVAL`` rounds.

A mission makes thousands of callbacks per second of CPU, so the loop replaces what asyncio does for each one: it has no
debug mode, and no queue of timers besides the timeline.
"""

from __future__ import annotations

import asyncio
import os
import selectors
import socket
import stat
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, TypeVarTuple, Unpack

from tsgt.simulation.kernel.timeline import VirtualTimeline

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Awaitable, Callable, Sequence, Sized
    from concurrent.futures import Executor
    from contextvars import Context

    from _typeshed import FileDescriptorLike

    from tsgt.simulation.kernel.timeline import Handle

_IDLE_POLL_INTERVAL = 64
"""Rounds between two polls without open connections."""

T = TypeVar("T")
Ts = TypeVarTuple("Ts")


class VirtualEventLoop(asyncio.SelectorEventLoop):
    """An event loop on a virtual timeline.

    Parameters
    ----------
    timeline
        Others may schedule events on it and advance it too.
    isolated
        No other thread or process takes part. Executor work then runs inline, which saves the thread switch, and listening
        sockets are polled rarely. Executor work that waits for something in the loop would deadlock.
    """

    if TYPE_CHECKING:  # BaseEventLoop's own, unknown to typeshed
        _ready: deque[asyncio.Handle]
        _stopping: bool

        def _process_events(self, event_list: list[tuple[selectors.SelectorKey, int]]) -> None: ...
        def _check_closed(self) -> None: ...

    def __init__(self, timeline: VirtualTimeline, *, isolated: bool = False) -> None:
        self._timeline = timeline
        self._isolated = isolated
        self._running_in_executor = 0
        self._running_inline = False
        self._suspended: list[_Suspension] = []
        self._jumping = selector = _TimeJumpSelector(
            timeline, time_frozen=lambda: self._running_in_executor > 0
        )
        super().__init__(selector)
        selector.attach(self._ready, self._suspended, isolated=isolated)

    def time(self) -> float:
        """Seconds since the timeline's zero; exact to the nanosecond for the first 26 days."""
        return self._timeline.now_ns() / 1e9

    def _run_once(self) -> None:
        """Make the callbacks that are ready, after a look at sockets and timeline."""
        ready = self._ready
        events = self._jumping.select(0 if ready or self._stopping else None)
        if events:
            self._process_events(events)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle._cancelled:  # noqa: SLF001 (as in asyncio's own loop)
                handle._run()  # noqa: SLF001

    def call_soon(
        self, callback: Callable[[Unpack[Ts]], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        """Call back in the next round."""
        self._check_closed()
        handle = _Callback(callback, args, self, copy_context() if context is None else context)
        self._ready.append(handle)
        return handle

    def call_at(
        self,
        when: float,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        """Schedule on the timeline, which orders all events, instead of the loop's own queue."""
        timer = _Timer(when, callback, args, self, copy_context() if context is None else context)
        timer.event = self._timeline.call_at(round(when * 1e9), partial(self._due, timer))
        return timer

    def _due(self, timer: asyncio.Handle) -> None:
        if self._suspended:
            self._add_or_hold(timer)
        else:
            self._ready.append(timer)

    async def sleep_until_ns(self, at_ns: int) -> None:
        """Sleep until a time of the timeline in ns; yields to other tasks at least once."""
        wakened = self.create_future()
        event = self._timeline.call_at(at_ns, partial(self._wake, wakened, copy_context()))
        try:
            await wakened
        finally:
            event.cancel()

    def _wake(self, sleeper: asyncio.Future[None], context: Context) -> None:
        if self._suspended:
            self._add_or_hold(_Callback(_set_if_pending, (sleeper, sleeper.set_result, None), self, context))
        else:
            _set_if_pending(sleeper, sleeper.set_result, None)

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[Unpack[Ts]], T], *args: *Ts
    ) -> asyncio.Future[T]:
        """Run in a thread or inline; time is frozen until it is done."""
        if self._isolated:
            return self._run_inline(func, *args)
        future = super().run_in_executor(executor, func, *args)
        self._running_in_executor += 1
        future.add_done_callback(self._executor_done)
        return future

    def _run_inline(self, func: Callable[[Unpack[Ts]], T], *args: *Ts) -> asyncio.Future[T]:
        """Run executor work now; the result is set in the next round, as with a thread."""
        future: asyncio.Future[T] = self.create_future()
        self._try_inline(future, func, *args)
        return future

    def _try_inline(self, future: asyncio.Future[T], func: Callable[[Unpack[Ts]], T], *args: *Ts) -> None:
        if future.done():  # cancelled while it was blocked
            return
        self._running_inline = True
        try:
            result = func(*args)
        except _BlockedError as blocked:
            self.call_at(blocked.until_s, self._try_inline, future, func, *args)
        except Exception as error:  # noqa: BLE001 (passed on to the caller)
            self.call_soon(_set_if_pending, future, future.set_exception, error)
        else:
            self.call_soon(_set_if_pending, future, future.set_result, result)
        finally:
            self._running_inline = False

    def block_executor_work(self, until_ns: int) -> None:
        """Block the executor work of an isolated loop that calls this, until a time; no effect for other callers.

        The work is abandoned and started again then: it must be able to continue where it was, as a write of queued lines is.
        """
        if self._running_inline and until_ns > self._timeline.now_ns():
            raise _BlockedError(until_ns / 1e9)

    def suspend(self, belongs: Callable[[Context], bool]) -> Callable[[], None]:
        """Hold back the callbacks of some contexts, as on a computer that is suspended; return what lets them run."""
        suspension = _Suspension(belongs)
        self._suspended.append(suspension)
        self._hold_callbacks()

        def resume() -> None:
            self._suspended.remove(suspension)
            self._hold_callbacks()
            for handle in suspension.held:
                self._add_callback(handle)

        return resume

    def _hold_callbacks(self) -> None:
        """Look at each callback while some are held; at other times this costs nothing."""
        if self._suspended:
            self.call_soon = self._call_soon_or_hold  # type: ignore[assignment, method-assign]
            self._add_callback = self._add_or_hold
        else:
            vars(self).pop("call_soon", None)
            vars(self).pop("_add_callback", None)

    def _call_soon_or_hold(
        self, callback: Callable[..., object], *args: Any, context: Context | None = None
    ) -> asyncio.Handle:
        handle = _Callback(callback, args, self, copy_context() if context is None else context)
        self._add_or_hold(handle)
        return handle

    def _add_or_hold(self, handle: asyncio.Handle) -> None:
        for suspension in self._suspended:
            if suspension.belongs(handle._context):  # type: ignore[attr-defined]  # noqa: SLF001 (asyncio's own)
                suspension.held.append(handle)
                return
        self._ready.append(handle)

    def _executor_done(self, _: asyncio.Future[Any]) -> None:
        self._running_in_executor -= 1

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:  # noqa: ARG002, ASYNC109
        """Wait for the executor's threads; the timeout of Python 3.12 would expire at once in virtual time."""
        self._running_in_executor += 1
        await super().shutdown_default_executor()
        self._running_in_executor -= 1


class _BlockedError(BaseException):
    """Executor work is blocked; not an Exception, so that it is not handled as an error of a disk."""

    def __init__(self, until_s: float) -> None:
        super().__init__(until_s)
        self.until_s = until_s


class _Suspension:
    """Callbacks that are held back."""

    def __init__(self, belongs: Callable[[Context], bool]) -> None:
        self.belongs = belongs
        self.held: list[asyncio.Handle] = []


def _ignore() -> None:
    """Do nothing."""


def _set_if_pending(future: asyncio.Future[Any], set_outcome: Callable[[Any], None], outcome: object) -> None:
    if not future.done():  # cancelled meanwhile
        set_outcome(outcome)


class _Callback(asyncio.Handle):
    """A handle that does not ask its loop whether it is in debug mode."""

    __slots__ = ()

    def __init__(
        self,
        callback: Callable[..., object],
        args: Sequence[Any],
        loop: asyncio.AbstractEventLoop,
        context: Context,
    ) -> None:
        self._callback = callback
        self._args = args
        self._loop = loop
        self._context = context
        self._cancelled = False
        self._repr = self._source_traceback = None

    def cancel(self) -> None:
        """Do not call back."""
        self._cancelled = True
        self._callback, self._args = _ignore, ()


class _Timer(_Callback, asyncio.TimerHandle):
    """A timer of the loop on the timeline."""

    __slots__ = ("event",)
    event: Handle

    def __init__(
        self,
        when: float,
        callback: Callable[..., object],
        args: Sequence[Any],
        loop: asyncio.AbstractEventLoop,
        context: Context,
    ) -> None:
        super().__init__(callback, args, loop, context)
        self._when = when
        self._scheduled = False  # in no queue of asyncio's

    def cancel(self) -> None:
        """Cancel the timeline's event as well."""
        self.event.cancel()
        super().cancel()


def run_virtual(
    main: Callable[[], Awaitable[T]], timeline: VirtualTimeline | None = None, *, isolated: bool = False
) -> T:
    """Run a coroutine function to completion on virtual time, like :func:`asyncio.run`; see :class:`VirtualEventLoop`."""

    async def run() -> T:
        return await main()

    loop_factory = partial(VirtualEventLoop, timeline or VirtualTimeline(), isolated=isolated)
    with asyncio.Runner(loop_factory=loop_factory) as runner:
        return runner.run(run())


class _TimeJumpSelector(selectors.DefaultSelector):
    """A selector that jumps to the next event where a loop would block."""

    def __init__(self, timeline: VirtualTimeline, time_frozen: Callable[[], bool]) -> None:
        super().__init__()
        self._timeline = timeline
        self._time_frozen = time_frozen
        self._ready: Sized = ()
        self._suspended: Sequence[_Suspension] = ()
        self._isolated = False
        self._connected_fds: set[int] = set()
        self._skipped_polls = 0

    def attach(self, ready: Sized, suspended: Sequence[_Suspension], *, isolated: bool) -> None:
        """Connect to the loop's queue of ready callbacks; files registered so far (wake-up sockets) do not count as connections."""
        self._ready = ready
        self._suspended = suspended
        self._isolated = isolated
        self._connected_fds.clear()

    def register(
        self, fileobj: FileDescriptorLike, events: int, data: object = None
    ) -> selectors.SelectorKey:
        """Register a file, as a connection unless it is a listening socket."""
        key = super().register(fileobj, events, data)
        if not _is_listening(key.fd):
            self._connected_fds.add(key.fd)
        return key

    def unregister(self, fileobj: FileDescriptorLike) -> selectors.SelectorKey:
        """Unregister a file."""
        key = super().unregister(fileobj)
        self._connected_fds.discard(key.fd)
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Poll the sockets; when the loop is idle (no timeout: it has no timers of its own), advance time."""
        timeline = self._timeline
        ready = self._poll()
        if timeout == 0:
            timeline.call_due()
            return ready
        while not (ready or self._ready):
            if self._time_frozen() or not timeline.call_next():
                return super().select()
            # Events of the hardware that make no callback ready need no round of the loop.
            if not self._ready:
                ready = self._poll()
        return ready

    def _poll(self) -> list[tuple[selectors.SelectorKey, int]]:
        self._skipped_polls += 1
        if self._isolated and not self._connected_fds and self._skipped_polls < _IDLE_POLL_INTERVAL:
            return []
        self._skipped_polls = 0
        events = super().select(0)
        # A socket of a suspended computer stays ready until its callback runs: it must not keep time from advancing.
        return [each for each in events if not self._is_held(each[0].data)] if self._suspended else events

    def _is_held(self, handles: object) -> bool:
        """Whether callbacks of a file, asyncio's pair of reader and writer, are held back."""
        pair = handles if isinstance(handles, tuple) else ()
        contexts = [each._context for each in pair if each is not None]  # noqa: SLF001 (asyncio's own)
        return any(suspension.belongs(each) for suspension in self._suspended for each in contexts)


def _is_listening(fd: int) -> bool:
    """Whether it is a listening socket."""
    if not stat.S_ISSOCK(os.fstat(fd).st_mode):
        return False
    # The family does not matter for reading the option.
    with socket.fromfd(fd, socket.AF_UNIX, socket.SOCK_STREAM) as copy:
        return bool(copy.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN))
