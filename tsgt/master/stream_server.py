"""Stream server: JSON lines on a UNIX socket, to any number of readers. docs/reference/stream.md describes them.

A reader that stalls must cost the others nothing, and know that it has lost lines: behind the buffers of kernel and
transport each has a queue, which drops its oldest line when full, and the reader gets an event ``lines_lost`` with the
number, and the newest ``setup`` of the dropped lines, which is not sent otherwise until it changes. There are no tasks: lines are sent from :meth:`StreamServer.publish` and the event loop's callbacks.
"""

from __future__ import annotations

import asyncio
import select
import time
from collections import deque
from typing import TYPE_CHECKING, Self

import structlog

from tsgt.recording import SETUP_START, EventRecord, encode_line
from tsgt.service import UnixListener

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

QUEUE_LINES = 2000

MAX_READERS = 64
"""Further readers are disconnected: each needs memory, and a file descriptor that the radio may need."""

CLOSE_TIMEOUT_S = 0.5  # how long readers have at the end to take their queues

_SETUP_ITERATIONS = 5
"""Iterations of the event loop from accepting a connection to its protocol, with reserve."""

log = structlog.get_logger()


class StreamServer:
    """Serves lines to every reader of a UNIX socket; an async context manager.

    A reader gets the greeting, the newest ``setup`` that was published, and then what is published. What readers send is ignored. On exit, readers have
    :data:`CLOSE_TIMEOUT_S` to take their queues. Entering raises StreamError if another program
    serves the socket, or it cannot be created.

    Parameters
    ----------
    path
        The socket. A stale one is replaced; the folder is created.
    hello
        The greeting, without line end.
    unix_now_ns
        The master's Unix clock, for the event ``lines_lost``.
    """

    def __init__(
        self,
        path: Path,
        hello: bytes,
        *,
        mode: int = 0o660,
        queue_lines: int = QUEUE_LINES,
        unix_now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._path = path
        self._greeting = hello + b"\n"
        self._setup = b""
        self._mode = mode
        self._queue_lines = queue_lines
        self._unix_now_ns = unix_now_ns
        self._readers: set[_Reader] = set()
        self._changed = asyncio.Event()
        self._closing = False

    async def __aenter__(self) -> Self:
        self._listener = UnixListener(self._path, self._mode)
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_unix_server(self._new_reader, sock=self._listener.socket)
        except BaseException:  # also when cancelled: __aexit__ is not called
            self._listener.remove()
            self._listener.socket.close()
            raise
        log.info("stream_opened", path=str(self._path))
        return self

    async def __aexit__(self, *_: object) -> None:
        self._closing = True
        self._listener.remove()
        # Accept no more connections, and let asyncio finish those that it is setting up while the server exists.
        asyncio.get_running_loop().remove_reader(self._listener.socket)
        for _iteration in range(_SETUP_ITERATIONS):
            await asyncio.sleep(0)
        self._server.close()
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await self._until(lambda: not any(reader.waiting for reader in self._readers))
                for reader in self._readers:
                    reader.close()
                await self._until(lambda: not self._readers)
        except TimeoutError:
            log.warning("stream_closed_on_slow_readers", readers=len(self._readers))
        finally:
            for reader in self._readers:
                reader.abort()
        await self._until(lambda: not self._readers)

    def greet_with(self, hello: bytes) -> None:
        """Greet further readers with another line, without line end."""
        self._greeting = hello + b"\n"

    @property
    def readers(self) -> int:
        """Number of connected readers."""
        return len(self._readers)

    def publish(self, line: bytes) -> None:
        """Send a line, without line end, to all readers; never waits, slow readers lose lines."""
        data = line + b"\n"
        if line.startswith(SETUP_START):
            self._setup = data
        for reader in self._readers:
            reader.send(data)

    async def publish_when_ready(self, line: bytes) -> None:
        """Send a line when every reader has room for it; no reader loses lines."""
        # Always yield to the event loop, so that readers can connect during many lines.
        await asyncio.sleep(0)
        await self._until(lambda: not any(reader.full for reader in self._readers))
        self.publish(line)

    async def finish(self) -> None:
        """Return when every reader has taken everything and is disconnected; for a replay."""
        await self._until(lambda: not any(reader.waiting for reader in self._readers))
        for reader in self._readers:
            reader.close()  # which sends what the transport still holds
        await self._until(lambda: not self._readers)

    async def wait_for_reader(self) -> None:
        """Return when at least one reader is connected."""
        await self._until(lambda: bool(self._readers))

    async def _until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            self._changed.clear()
            await self._changed.wait()

    def _new_reader(self) -> asyncio.Protocol:
        if self._closing:
            return _RejectedConnection()
        return _Reader(
            self._readers, self._changed, self._present_greeting, self._queue_lines, self._unix_now_ns
        )

    def _present_greeting(self) -> bytes:
        return self._greeting + self._setup


class _RejectedConnection(asyncio.Protocol):
    """A connection that was accepted while the server was closing."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


class _Reader(asyncio.Protocol):
    """One connection: lines go to the transport, or to the queue while it is full."""

    def __init__(
        self,
        readers: set[_Reader],
        changed: asyncio.Event,
        greeting: Callable[[], bytes],
        queue_lines: int,
        unix_now_ns: Callable[[], int],
    ) -> None:
        self._readers = readers
        self._changed = changed
        self._greeting = greeting
        self._queue: deque[bytes] = deque()
        self._queue_lines = queue_lines
        self._unix_now_ns = unix_now_ns
        self._paused = False
        self._lost = 0
        self._lost_setup = b""
        """The newest ``setup`` among the lost lines; not counted in them, for it is sent behind them."""

    @property
    def waiting(self) -> bool:
        return bool(self._queue)

    @property
    def full(self) -> bool:
        return len(self._queue) >= self._queue_lines

    def send(self, data: bytes) -> None:
        if self._transport.is_closing():
            return  # it has just gone: asyncio would log each further write
        if not self._paused:
            self._transport.write(data)
            return
        if self.full:
            dropped = self._queue.popleft()
            if dropped.startswith(SETUP_START):
                self._lost_setup, dropped = dropped, self._lost_setup
            self._lost += bool(dropped)
        self._queue.append(data)

    def close(self) -> None:
        self._transport.close()

    def abort(self) -> None:
        self._transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)  # noqa: S101 (a stream socket has one)
        self._transport = transport
        if len(self._readers) >= MAX_READERS:
            log.warning("reader_refused", readers=len(self._readers))
            self.abort()
            return
        self._transport.write(self._greeting())
        self._readers.add(self)
        self._changed.set()
        log.info("reader_connected", readers=len(self._readers))

    def data_received(self, data: bytes) -> None:
        """Ignore what readers send."""

    def eof_received(self) -> bool:
        """Keep the connection of a reader that only closed its sending side, as a shell pipe through socat."""
        poller = select.poll()
        poller.register(self._transport.get_extra_info("socket").fileno(), select.POLLOUT)
        return not any(events & select.POLLHUP for _, events in poller.poll(0))

    def pause_writing(self) -> None:
        self._paused = True

    def resume_writing(self) -> None:
        self._paused = False
        if self._lost:
            log.warning("reader_lost_lines", count=self._lost)
            self._transport.write(encode_line(self._lines_lost()) + b"\n")
            self._lost = 0
        if self._lost_setup:
            self._transport.write(self._lost_setup)
            self._lost_setup = b""
        while self._queue and not self._paused:
            self._transport.write(self._queue.popleft())
        self._changed.set()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (the reason does not matter)
        if self not in self._readers:
            return  # beyond MAX_READERS
        self._readers.discard(self)
        self._changed.set()
        log.info("reader_disconnected", readers=len(self._readers))

    def _lines_lost(self) -> EventRecord:
        return EventRecord(
            stamp_ns=self._unix_now_ns(),
            event="lines_lost",
            message=f"this reader was too slow and lost {self._lost} lines here",
            count=self._lost,
        )
