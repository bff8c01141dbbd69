"""Limits on connections, which aiohttp has not: how many there are, and how long a request may take to arrive."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from collections.abc import Callable

    from aiohttp import web

MAX_CONNECTIONS = 256
MAX_CONNECTIONS_PER_ADDRESS = 64
"""Each browser has one that stays, and a few for a moment when the page is loaded."""

REQUEST_TIMEOUT_S = 5.0
"""From the connection, with TLS from the end of its handshake, until the headers of the request are complete."""


class Connections:
    """Makes the protocols of the connections, with limits."""

    def __init__(self, runner: web.AppRunner) -> None:
        server = runner.server
        assert server is not None  # noqa: S101 (the runner is set up)
        self._make = cast("Callable[[], web.RequestHandler]", server)
        self._by_address: Counter[str] = Counter()

    def protocol(self) -> asyncio.Protocol:
        """Return the protocol of a new connection."""
        return _Limited(self._make(), self._by_address)


class _Limited(asyncio.Protocol):
    """Passes everything on to aiohttp's protocol, or closes the connection at once.

    The transport calls this one; aiohttp's writes to the transport itself.
    """

    def __init__(self, inner: web.RequestHandler, by_address: Counter[str]) -> None:
        self._inner = inner
        self._by_address = by_address
        self._address: str | None = None  # while it is counted
        self._timer: asyncio.TimerHandle | None = None
        self._transport: asyncio.Transport | None = None
        self._tail = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 (a TCP connection has one)
        peer = transport.get_extra_info("peername")
        address = str(peer[0]) if peer else ""
        counts = self._by_address
        if counts.total() >= MAX_CONNECTIONS or counts[address] >= MAX_CONNECTIONS_PER_ADDRESS:
            transport.abort()
            return
        self._transport, self._address = transport, address
        counts[address] += 1
        self._timer = asyncio.get_running_loop().call_later(REQUEST_TIMEOUT_S, transport.abort)
        self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        if self._address is None:
            return
        if self._timer is not None:
            if b"\r\n\r\n" in self._tail + data:  # the headers are complete; the body has its own time-out
                self._timer.cancel()
                self._timer = None
            self._tail = (self._tail + data)[-3:]
        self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        if self._address is None:
            return None
        self._inner.eof_received()
        return None

    def pause_writing(self) -> None:
        if self._address is not None:
            self._inner.pause_writing()

    def resume_writing(self) -> None:
        if self._address is not None:
            self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._address is None:
            return
        self._by_address[self._address] -= 1
        if not self._by_address[self._address]:
            del self._by_address[self._address]
        self._address = None
        self._inner.connection_lost(exc)
