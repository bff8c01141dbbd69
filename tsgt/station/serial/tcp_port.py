"""A line to an instrument over TCP: its WLAN or LAN interface, or a serial device server.

TCP delivers bytes in order and undamaged, but late: seconds over Wi-Fi. A connection whose other end has gone is noticed by
the missing replies, or by the kernel's keepalive where nothing is requested.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import socket
import struct
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from tsgt.errors import InstrumentError
from tsgt.station.serial.base import Chunk
from tsgt.station.serial.chunk_queue import ChunkQueue

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.config import TcpAddress
    from tsgt.station.serial.base import Port

CONNECT_TIMEOUT_S: Final = 5.0  # SYN is repeated after 1 s and 3 s
_KEPT_BYTES: Final = 65_536  # then reading pauses: unread data must not fill the memory
_KEEPALIVE_IDLE_S, _KEEPALIVE_INTERVAL_S, _KEEPALIVE_PROBES = 5, 2, 5
_USER_TIMEOUT_MS: Final = (
    15_000  # unacknowledged data for longer is a lost connection; stalls of some seconds are not
)

_REASONS: Final = {
    errno.ECONNREFUSED: "nothing listens there: check address and port, and that GeoCOM is set to this interface",
    errno.EHOSTUNREACH: "the host does not answer: check that instrument and computer are in the same network",
    errno.EHOSTDOWN: "the host does not answer: check that instrument and computer are in the same network",
    errno.ENETUNREACH: "this computer has no network to there: check its Wi-Fi or cable",
    errno.ETIMEDOUT: "the host does not answer: check that instrument and computer are in the same network",
}


async def open_tcp_port(address: TcpAddress, clock: Clock) -> Port:
    """Connect; raises InstrumentError if the name is unknown, or nothing answers within the time-out."""
    name = str(address)
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            where = await _resolve(address.host, address.port)
            port = _TcpPort(name, clock)
            await asyncio.get_running_loop().create_connection(lambda: port, *where)
    except TimeoutError as error:
        raise InstrumentError(
            f"{name}: no answer within {CONNECT_TIMEOUT_S:g} s; check that instrument and computer are in the same network"
        ) from error
    except OSError as error:
        reason = _REASONS.get(error.errno or 0) or error.strerror or str(error)
        raise InstrumentError(f"{name} cannot be connected: {reason}") from error
    return port


async def _resolve(host: str, port: int) -> tuple[str, int]:
    """Return the address of a host. Not by the executor: a name server that is silent would occupy its threads for minutes."""
    with suppress(ValueError):
        return str(ipaddress.ip_address(host)), port
    loop = asyncio.get_running_loop()
    found: asyncio.Future[str] = loop.create_future()

    def settle(address: str, problem: str) -> None:
        if found.done():  # given up
            return
        if problem:
            found.set_exception(InstrumentError(problem))
        else:
            found.set_result(address)

    def look_up() -> None:
        address, problem = "", ""
        try:
            address = str(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][4][0])
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            problem = f"tcp://{host}:{port}: the name cannot be resolved ({reason}); use the IP address"
        with suppress(RuntimeError):  # the loop has ended meanwhile
            loop.call_soon_threadsafe(settle, address, problem)

    threading.Thread(target=look_up, name="resolve", daemon=True).start()
    return await found, port


class _TcpPort(asyncio.Protocol):
    """A :class:`~tsgt.station.serial.base.Port`."""

    baud: Final = None

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self._clock = clock
        self._transport: Any = None
        self._closed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._received = ChunkQueue()
        self._kept = 0
        self._has_received = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        link = transport.get_extra_info("socket")
        for level, option, value in (
            (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
            (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
            (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _KEEPALIVE_IDLE_S),
            (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _KEEPALIVE_INTERVAL_S),
            (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _KEEPALIVE_PROBES),
            (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _USER_TIMEOUT_MS),
        ):
            link.setsockopt(level, option, value)
        # Closing resets the connection: the kernel would otherwise deliver old requests later, and turn the telescope then.
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    def data_received(self, data: bytes) -> None:
        self._has_received = True
        self._received.put(Chunk(data, self._clock.monotonic_ns()))
        self._kept += len(data)
        if self._kept > _KEPT_BYTES:
            self._transport.pause_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        self._received.fail(self._lost_message(exc))
        if not self._closed.done():
            self._closed.set_result(None)

    def write(self, data: bytes) -> None:
        self._received.check()
        self._transport.write(data)

    async def read(self) -> Chunk:
        chunk = await self._received.read()
        self._taken(len(chunk.data))
        return chunk

    def drain(self) -> bytes:
        data = self._received.drain()
        self._taken(len(data))
        return data

    async def close(self) -> None:
        self._received.fail(f"{self.name}: closed")
        self._transport.abort()
        await asyncio.shield(self._closed)

    def _taken(self, count: int) -> None:
        paused, self._kept = self._kept > _KEPT_BYTES, self._kept - count
        if paused and self._kept <= _KEPT_BYTES and not self._transport.is_closing():
            self._transport.resume_reading()

    def _lost_message(self, error: Exception | None) -> str:
        if not self._has_received:
            return f"{self.name}: the connection was closed at once; another program may be connected, an instrument takes one"
        if error is None:
            return f"{self.name}: the instrument has closed the connection"
        return f"{self.name}: the connection is lost ({getattr(error, 'strerror', None) or error})"
