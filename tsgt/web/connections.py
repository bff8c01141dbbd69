"""Limits on connections, which aiohttp has not: how many there are, and how long handshake and request may take."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NoReturn

from tsgt.web.access import network

if TYPE_CHECKING:
    import socket
    import ssl
    from collections.abc import Callable

    from aiohttp import web

MAX_CONNECTIONS = 256
MAX_CONNECTIONS_PER_ADDRESS = 64
"""Each browser has one that stays, and a few for a moment when the page is loaded. With IPv6, from one network."""

HANDSHAKE_TIMEOUT_S = 3.0
REQUEST_TIMEOUT_S = 5.0
"""From the connection, with TLS from the end of its handshake, until the headers of the request are complete."""

RETRY_S = 1.0
"""After a connection could not be accepted, as when all of the computer's files are in use."""


class Connections:
    """Accepts connections within limits, and passes them to aiohttp.

    They count from then on: asyncio's own server tells of one only after the handshake of TLS, which takes more memory
    than the rest.
    """

    def __init__(self) -> None:
        self._open: dict[web.RequestHandler, _Connection] = {}

    async def accept(
        self, listener: socket.socket, make: Callable[[], web.RequestHandler], context: ssl.SSLContext | None
    ) -> NoReturn:
        """Accept connections until cancelled; ``make``: makes aiohttp's protocol for one."""
        loop = asyncio.get_running_loop()
        async with asyncio.TaskGroup() as tasks:
            while True:
                try:
                    accepted, peer = await loop.sock_accept(listener)
                except OSError:
                    await asyncio.sleep(RETRY_S)
                    continue
                by = network(peer[0])
                if not self._has_room(by):
                    accepted.close()
                    continue
                connection = _Connection(make(), by, self._open)
                self._open[connection.inner] = connection
                tasks.create_task(connection.open(accepted, context))

    def _has_room(self, by: str) -> bool:
        networks = [each.network for each in self._open.values()]
        return len(networks) < MAX_CONNECTIONS and networks.count(by) < MAX_CONNECTIONS_PER_ADDRESS

    def headers_complete(self, request: web.Request) -> None:
        """Take note that a request has arrived; its body has a time-out of its own."""
        connection = self._open.get(request.protocol)
        if connection is not None:
            connection.stop_timer()


class _Connection(asyncio.Protocol):
    """Passes everything on to aiohttp's protocol, which writes to the transport itself."""

    def __init__(
        self, inner: web.RequestHandler, by: str, open_: dict[web.RequestHandler, _Connection]
    ) -> None:
        self.inner = inner
        self.network = by
        self._open = open_  # this one is in it as long as it counts
        self._timer: asyncio.TimerHandle | None = None

    async def open(self, accepted: socket.socket, context: ssl.SSLContext | None) -> None:
        """Make the transport, with TLS after its handshake."""
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: self,
                accepted,
                ssl=context,
                ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S if context else None,
            )
        except Exception:  # noqa: BLE001 (whatever is wrong with a handshake costs one connection, not the page)
            self._open.pop(self.inner, None)  # connection_lost is called only after connection_made

    def stop_timer(self) -> None:
        """Let the connection stay."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 (a TCP connection has one)
        self._timer = asyncio.get_running_loop().call_later(REQUEST_TIMEOUT_S, transport.abort)
        self.inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        self.inner.data_received(data)

    def eof_received(self) -> bool | None:
        self.inner.eof_received()
        return None

    def pause_writing(self) -> None:
        self.inner.pause_writing()

    def resume_writing(self) -> None:
        self.inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        self.stop_timer()
        self._open.pop(self.inner, None)
        self.inner.connection_lost(exc)
