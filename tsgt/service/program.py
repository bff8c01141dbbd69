"""A program as a child process: passes its output on as it arrives, and its stderr to the log."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Protocol

from tsgt.errors import InstrumentError
from tsgt.service.program_lines import LineSplitter, printable

if TYPE_CHECKING:
    from tsgt.clock import Clock

END_TIMEOUT_S = 0.3  # time from SIGTERM to SIGKILL; the daemon itself must end within a second

KILL_TIMEOUT_S = 0.1  # how long to wait for the end of a killed program

OUTPUT_DRAIN_S = 0.2
"""How long to wait for output printed before the program ended; its own children may keep the pipes open."""

STDERR_LINES_PER_S = 20  # further lines are counted, and not logged

MAX_STDERR_LINE_BYTES = 16_384

LogStderr = Callable[[str, int], None]
"""Logs a line of a program's stderr; also takes the number of lines that were not logged so far."""


class Listener(Protocol):
    """Receives the output and the end of a program; must not block."""

    def output_received(self, data: bytes, at_ns: int) -> None:
        """Handle data from stdout, which arrived at this time on CLOCK_MONOTONIC."""

    def exited(self, reason: str) -> None:
        """Handle the end of the program, or of its output: called once, after all its output."""


class Program(Protocol):
    """A running program."""

    def write(self, data: bytes) -> None:
        """Queue data for its stdin, without waiting; no effect after its end."""

    def kill(self) -> None:
        """Kill it and its children at once."""

    async def terminate(self) -> None:
        """Terminate it, and kill it if it does not end; when this returns or is cancelled, it has ended."""


StartProgram = Callable[[Sequence[str], Listener], Coroutine[Any, Any, Program]]
"""Starts a program with its arguments; raises InstrumentError."""


async def start_process(
    command: Sequence[str], listener: Listener, clock: Clock, *, setting: str, log_stderr: LogStderr
) -> Program:
    """Start a child process in a session of its own, which Ctrl-C does not reach; raises InstrumentError on failure.

    ``setting``: key of the command in the configuration, for the error.
    """
    environment = dict(os.environ)
    environment.pop("NOTIFY_SOCKET", None)  # it must not notify systemd on behalf of the service
    try:
        _, process = await asyncio.get_running_loop().subprocess_exec(
            lambda: _Process(listener, clock, log_stderr), *command, env=environment, start_new_session=True
        )
    except (OSError, ValueError) as error:  # ValueError: a zero byte among the arguments
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InstrumentError(
            f"{command[0]}: cannot be started ({reason}); check {setting} in the configuration"
        ) from error
    return process


class _Process(asyncio.SubprocessProtocol):
    """The process and its pipes."""

    _transport: asyncio.SubprocessTransport

    def __init__(self, listener: Listener, clock: Clock, log_stderr: LogStderr) -> None:
        self._listener = listener
        self._clock = clock
        self._exited = asyncio.Event()
        self._reported = False
        self._stderr = _Stderr(clock, log_stderr)

    # --- Program ----------------------------------------------------------------------------------------------

    def write(self, data: bytes) -> None:
        stdin = self._transport.get_pipe_transport(0)
        if isinstance(stdin, asyncio.WriteTransport) and not stdin.is_closing():
            stdin.write(data)

    def kill(self) -> None:
        if not self._exited.is_set():
            self._signal(signal.SIGKILL)

    async def terminate(self) -> None:
        try:
            if not self._exited.is_set():
                if (stdin := self._transport.get_pipe_transport(0)) is not None:
                    stdin.close()
                self._signal(signal.SIGTERM)
                await self._wait(END_TIMEOUT_S)
        finally:
            self.kill()
            self._reported = True
            self._transport.close()
        await self._wait(KILL_TIMEOUT_S)

    async def _wait(self, limit_s: float) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                await self._exited.wait()

    def _signal(self, number: signal.Signals) -> None:
        """Signal its whole session: a surviving child would keep the instrument."""
        with suppress(ProcessLookupError, PermissionError):  # the id may be another user's by now
            os.killpg(self._transport.get_pid(), number)

    # --- asyncio.SubprocessProtocol ---------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.SubprocessTransport)  # noqa: S101 (asyncio's promise)
        self._transport = transport

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        if fd == 1:
            self._listener.output_received(data, self._clock.monotonic_ns())
        else:
            self._stderr.add(data)

    def pipe_connection_lost(self, fd: int, exc: Exception | None) -> None:  # noqa: ARG002 (it is closed in any case)
        if fd == 1:
            self._report_soon()

    def process_exited(self) -> None:
        self._signal(signal.SIGKILL)  # now, before its session id can be reused
        self._exited.set()
        self._report_soon()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (it has ended in any case)
        """Report at once: it has ended, and all its output has arrived."""
        self._report_end()

    def _report_soon(self) -> None:
        asyncio.get_running_loop().call_later(OUTPUT_DRAIN_S, self._report_end)

    def _report_end(self) -> None:
        if self._reported:
            return
        self._reported = True
        status = self._transport.get_returncode()
        if status is None:
            reason = "it has closed its output"
        elif status < 0:
            reason = f"killed by signal {-status}"
        else:
            reason = f"exit status {status}"
        self._listener.exited(f"{reason}: {self._stderr.last}" if self._stderr.last else reason)


class _Stderr:
    """Logs a program's stderr, up to a rate; ``last`` is the last line."""

    def __init__(self, clock: Clock, log_stderr: LogStderr) -> None:
        self._clock = clock
        self._log_stderr = log_stderr
        self._splitter = LineSplitter(MAX_STDERR_LINE_BYTES)
        self._second = -1
        self._logged = 0
        self._dropped = 0
        self.last = ""

    def add(self, data: bytes) -> None:
        """Log the lines completed by this data."""
        second = self._clock.monotonic_ns() // 1_000_000_000
        if second != self._second:
            self._second, self._logged = second, 0
        for line in self._splitter.push(data):
            self.last = printable(line.decode(errors="replace"))
            if self._logged == STDERR_LINES_PER_S:
                self._dropped += 1
                continue
            self._logged += 1
            self._log_stderr(self.last, self._dropped)
