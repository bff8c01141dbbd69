"""A program of the user's as a child process: its lines come in as they are printed, its stderr goes to the log."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Protocol

import structlog

from tsgt.errors import InstrumentError
from tsgt.station.bridge.messages import LineCutter, for_people

if TYPE_CHECKING:
    from tsgt.clock import Clock

END_TIMEOUT_S = 0.3
"""How long it has to end when it is told to; the client itself has to end within a second."""

KILL_TIMEOUT_S = 0.1
"""How long is waited for it to be gone after it was killed."""

LAST_WORDS_S = 0.2
"""How long is waited for what it has printed before it ended; a child of its own may keep the pipes open."""

STDERR_LINES_PER_S = 20
"""More are counted, and not logged."""

log = structlog.get_logger()


class Listener(Protocol):
    """Is told what a program does; never waits."""

    def said(self, data: bytes, at_ns: int) -> None:
        """Take what it has printed to stdout, and when that was here, on CLOCK_MONOTONIC in ns."""
        ...

    def ended(self, how: str) -> None:
        """Take it that it has ended, or can say no more, in words for people: once, after all that it has printed."""
        ...


class Program(Protocol):
    """A program that runs."""

    def write(self, data: bytes) -> None:
        """Put bytes into its stdin; they are queued, nothing is waited for. Without effect when it has ended."""
        ...

    def kill(self) -> None:
        """End it at once, with what it has started."""
        ...

    async def end(self) -> None:
        """Tell it to end, and kill it when it does not; when this returns or is cancelled, it is no more."""
        ...


StartProgram = Callable[[Sequence[str], Listener], Coroutine[Any, Any, Program]]
"""Starts a program with its arguments; raises InstrumentError."""


async def start_process(command: Sequence[str], listener: Listener, clock: Clock) -> Program:
    """Start a program as a child process, in a session of its own so that nobody's Ctrl-C is meant for it.

    Raises
    ------
    InstrumentError
        It cannot be started: no such program, no permission.
    """
    environment = dict(os.environ)
    environment.pop("NOTIFY_SOCKET", None)  # it is not the service, and must not speak for it
    try:
        _, process = await asyncio.get_running_loop().subprocess_exec(
            lambda: _Process(listener, clock), *command, env=environment, start_new_session=True
        )
    except (OSError, ValueError) as error:  # ValueError: a zero byte among the arguments
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InstrumentError(
            f"{command[0]}: cannot be started ({reason}); see to instrument.command in the configuration"
        ) from error
    return process


class _Process(asyncio.SubprocessProtocol):
    """The process and its pipes."""

    _transport: asyncio.SubprocessTransport

    def __init__(self, listener: Listener, clock: Clock) -> None:
        self._listener = listener
        self._clock = clock
        self._exited = asyncio.Event()
        self._told = False
        self._stderr = _Stderr(clock)

    # --- Program ----------------------------------------------------------------------------------------------

    def write(self, data: bytes) -> None:
        stdin = self._transport.get_pipe_transport(0)
        if isinstance(stdin, asyncio.WriteTransport) and not stdin.is_closing():
            stdin.write(data)

    def kill(self) -> None:
        if not self._exited.is_set():
            self._signal(signal.SIGKILL)

    async def end(self) -> None:
        try:
            if not self._exited.is_set():
                if (stdin := self._transport.get_pipe_transport(0)) is not None:
                    stdin.close()
                self._signal(signal.SIGTERM)
                await self._wait(END_TIMEOUT_S)
        finally:
            self.kill()
            self._told = True
            self._transport.close()
        await self._wait(KILL_TIMEOUT_S)

    async def _wait(self, limit_s: float) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                await self._exited.wait()

    def _signal(self, number: signal.Signals) -> None:
        """To all of its session, which a script may have filled: a child that stays would keep the instrument."""
        with suppress(ProcessLookupError, PermissionError):  # it may have become another user's
            os.killpg(self._transport.get_pid(), number)

    # --- asyncio.SubprocessProtocol ---------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.SubprocessTransport)  # noqa: S101 (asyncio's promise)
        self._transport = transport

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        if fd == 1:
            self._listener.said(data, self._clock.monotonic_ns())
        else:
            self._stderr.said(data)

    def pipe_connection_lost(self, fd: int, exc: Exception | None) -> None:  # noqa: ARG002 (it is closed in any case)
        if fd == 1:
            self._tell_soon()

    def process_exited(self) -> None:
        self._signal(signal.SIGKILL)  # now, while the number of its session cannot be another's yet
        self._exited.set()
        self._tell_soon()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (it has ended in any case)
        """Tell at once: it has ended, and all that it had to say is here."""
        self._tell()

    def _tell_soon(self) -> None:
        asyncio.get_running_loop().call_later(LAST_WORDS_S, self._tell)

    def _tell(self) -> None:
        if self._told:
            return
        self._told = True
        status = self._transport.get_returncode()
        if status is None:
            how = "it has closed its output"
        elif status < 0:
            how = f"killed by signal {-status}"
        else:
            how = f"exit status {status}"
        self._listener.ended(f"{how}: {self._stderr.last}" if self._stderr.last else how)


class _Stderr:
    """Puts what a program complains of into the log, but not all of it.

    Attributes
    ----------
    last
        The last line.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._cutter = LineCutter()
        self._second = -1
        self._logged = 0
        self._dropped = 0
        self.last = ""

    def said(self, data: bytes) -> None:
        """Take bytes."""
        second = self._clock.monotonic_ns() // 1_000_000_000
        if second != self._second:
            self._second, self._logged = second, 0
        for line in self._cutter.push(data):
            self.last = for_people(line.decode(errors="replace"))
            if self._logged == STDERR_LINES_PER_S:
                self._dropped += 1
                continue
            self._logged += 1
            log.info("bridge_stderr", text=self.last, dropped=self._dropped)
