"""TCP server of the relay: handshakes, and frames to readers that have the key. docs/reference/relay.md has the protocol.

Each reader has its own place in the shared buffer and takes frames as its connection accepts them, so a stalled one costs
the others nothing: when its place is no longer held, it goes on at the oldest line. There are no tasks.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
from typing import TYPE_CHECKING, Self

import structlog

from tsgt.client import relay_wire as wire
from tsgt.errors import StreamError
from tsgt.relay.admission import MAX_PENDING, MAX_PENDING_OF_ADDRESS, MAX_READERS, Admission
from tsgt.service import LogLimiter

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable

    from tsgt.relay.buffer import LineBuffer

HANDSHAKE_TIMEOUT_S = 5.0

DEAD_READER_TIMEOUT_MS = 15_000  # without an acknowledgement by the reader's computer

UNSENT_BYTES = 1 << 16
"""Most that the kernel holds unsent for a reader: what is there is out of our hands, and grows old."""

_ACCEPT_BACKLOG = 128

log = structlog.get_logger()


class RelayServer:
    """Serves the lines of a buffer; an async context manager.

    Parameters
    ----------
    host, port
        Where to listen; port 0: any.
    key
        The relay's key.
    tls
        Settings of TLS, and what binds proofs to the certificate; None: without TLS.
    now_ns
        Monotonic clock.
    """

    def __init__(
        self,
        host: str,
        port: int,
        key: bytes,
        buffer: LineBuffer,
        *,
        tls: tuple[ssl.SSLContext, str] | None,
        now_ns: Callable[[], int],
    ) -> None:
        self.host, self.port = host, port
        self.key = key
        self.buffer = buffer
        self.tls = tls
        self.now_ns = now_ns
        self.admission = Admission()
        self.pending: dict[_Connection, None] = {}  # oldest first
        self.readers: set[_Connection] = set()
        self._limiter = LogLimiter()

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(
                lambda: _Connection(self), self.host, self.port, backlog=_ACCEPT_BACKLOG
            )
        except OSError as error:
            reason = error.strerror or error
            raise StreamError(
                f"{self.host}:{self.port}: cannot listen there ({reason}); give an address of this computer and a free "
                "port with --listen"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]
        log.info("relay_opened", address=self.host, port=self.port, tls=self.tls is not None)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for connection in [*self.pending, *self.readers]:
            connection.abort()
        await self._server.wait_closed()
        await asyncio.sleep(0)  # for the callbacks of the aborted connections

    def line(self, line: bytes) -> None:
        """Add a line, without line end, and send it."""
        self.buffer.append(line, self.now_ns())
        for reader in [*self.readers]:
            reader.send_lines()

    def beat(self, *, connected: bool) -> None:
        """Send a sign of life to readers that have everything."""
        frame = self.buffer.beat(self.now_ns(), connected=connected)
        for reader in [*self.readers]:
            reader.send_beat(frame)

    def reject(self, address: str, reason: str) -> None:
        """Log a rejected connection, at most once a minute for each reason."""
        if self._limiter.allows(reason, self.now_ns()):
            log.warning("relay_reader_rejected", address=address, reason=reason)

    def make_room(self, address: str) -> None:
        """Close the oldest pending connection if there are too many."""
        of_address = [each for each in self.pending if each.address == address]
        if len(of_address) >= MAX_PENDING_OF_ADDRESS:
            self.reject(address, "too many connections without a key")
            of_address[0].abort()
        elif len(self.pending) >= MAX_PENDING:
            oldest = next(iter(self.pending))
            self.reject(oldest.address, "too many connections without a key")
            oldest.abort()


class _Connection(asyncio.Protocol):
    """One connection: pending until it has shown the key, then a reader."""

    def __init__(self, server: RelayServer) -> None:
        self._server = server
        self._handshake = bytearray()
        self._paused = False
        self._number = 0
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 (a TCP connection)
        self._transport = transport
        server = self._server
        peer = transport.get_extra_info("peername")
        self.address = str(peer[0]) if peer else "unknown"
        if not server.admission.admits(self.address, server.now_ns()):
            server.reject(self.address, "too many attempts")
            transport.abort()
            return
        server.make_room(self.address)
        server.pending[self] = None
        self._timer = asyncio.get_running_loop().call_later(HANDSHAKE_TIMEOUT_S, self._too_slow)
        own = transport.get_extra_info("socket")
        own.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, DEAD_READER_TIMEOUT_MS)
        own.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        self._challenge = wire.challenge(secrets.token_bytes(wire.NONCE_BYTES))
        if server.tls is None:
            self._tls = None
            self._channel = wire.NO_CHANNEL
            self._write(self._challenge.encode() + b"\n")
        else:
            from tsgt.client.tls import Tls  # noqa: PLC0415 (ssl is loaded where it is used)

            context, self._channel = server.tls
            self._tls = Tls(context, server_side=True)

    def data_received(self, data: bytes) -> None:
        if self._tls is not None:
            was_open = self._tls.open
            try:
                data = self._tls.receive(data)
            except StreamError:
                self._fail("no TLS, or another version")
                return
            if self._tls.open and not was_open:
                self._write(self._challenge.encode() + b"\n")
            else:
                self._write(b"")
        if self in self._server.readers or not data:
            return  # readers have nothing to say
        self._handshake += data
        line, end, _ = bytes(self._handshake).partition(b"\n")
        if end:
            self._request(line)
        elif len(self._handshake) > wire.MAX_HANDSHAKE_BYTES:
            self._fail("not a request")

    def _request(self, line: bytes) -> None:
        server = self._server
        try:
            requested = line.decode("ascii")
            wanted = wire.check_request(server.key, self._channel, self._challenge, requested)
        except (UnicodeDecodeError, wire.AuthenticationError):
            server.admission.wrong_key(self.address, server.now_ns())
            self._fail("wrong key")
            return
        full = len(server.readers) >= MAX_READERS
        start, heads = server.buffer.waiting_start(wanted) if full else server.buffer.start(wanted)
        welcome = wire.welcome(server.key, self._channel, self._challenge, requested, start, server.now_ns())
        greeting = welcome.encode() + b"\n"
        if full:
            server.reject(self.address, "too many readers")
            self._write(greeting + server.buffer.full(start.number, server.now_ns()) + b"".join(heads))
            self._transport.close()
            return  # without forgetting its attempts
        server.admission.right_key(self.address)
        self._stop_timer()
        server.pending.pop(self, None)
        server.readers.add(self)
        self._number = start.number
        self._write(greeting + b"".join(heads))
        log.info(
            "relay_reader_connected",
            address=self.address,
            readers=len(server.readers),
            resumed=wanted == start,
        )
        self.send_lines()

    def send_lines(self) -> None:
        """Send lines as far as the connection takes them."""
        buffer = self._server.buffer
        while not self._paused and self._number < buffer.next:
            if self._number < buffer.oldest:
                start, heads = buffer.skip()
                log.warning(
                    "relay_reader_lost_lines", address=self.address, count=start.number - self._number
                )
                self._number = start.number
                self._write(b"".join(heads))
            else:
                self._write(buffer.frame(self._number))
                self._number += 1

    def send_beat(self, frame: bytes) -> None:
        """Send a sign of life if everything else is sent."""
        if not self._paused and self._number == self._server.buffer.next:
            self._write(frame)

    def pause_writing(self) -> None:
        self._paused = True

    def resume_writing(self) -> None:
        self._paused = False
        if self in self._server.readers:
            self.send_lines()

    def abort(self) -> None:
        """Close at once; nothing is sent any more."""
        self._forget()
        self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (the reason does not matter)
        self._stop_timer()
        self._forget()

    def _forget(self) -> None:
        server = self._server
        server.pending.pop(self, None)
        if self in server.readers:
            server.readers.discard(self)
            log.info("relay_reader_disconnected", address=self.address, readers=len(server.readers))

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _write(self, data: bytes) -> None:
        if (
            self._transport.is_closing()
        ):  # asyncio logs writes to a reader that has gone, and its TLS may have failed
            return
        if self._tls is not None:
            if data:
                self._tls.send(data)
            data = self._tls.outgoing()
        if data:
            self._transport.write(data)

    def _too_slow(self) -> None:
        self._fail("no answer to the challenge")

    def _fail(self, reason: str) -> None:
        self._server.reject(self.address, reason)
        self.abort()
