"""The control socket of a station's client: reports its status and takes requests, one JSON line each.

A client of the socket receives one line, the status. If it sends a request within a second, it receives a response. Then
the connection is closed.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NoReturn, Self

from tsgt.config import PressureHpa, TemperatureC  # noqa: TC001 (pydantic resolves annotations at run time)
from tsgt.recording import encode_line
from tsgt.recording.journal import InstrumentRecord  # noqa: TC001 (likewise)
from tsgt.service import UnixListener

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path
    from socket import socket

    from tsgt.station.status import ClientStatus

REQUEST_TIMEOUT_S = 1.0
"""Clients that only want the status close at once, or are disconnected after this time."""

MAX_REQUEST_BYTES = 4096

MAX_CONNECTIONS = 32
"""Further ones are closed at once, so that file descriptors remain for instrument and radio."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AtmosphereRequest:
    """Request to set the atmospheric correction; see :class:`~tsgt.station.instrument.Atmosphere`."""

    type: Literal["atmosphere"] = "atmosphere"
    temperature_c: TemperatureC
    pressure_hpa: PressureHpa


@dataclass(frozen=True, slots=True, kw_only=True)
class AtmosphereResponse:
    """Why the setting was not applied, or not yet (empty: it was), and the settings as read back (null: unknown)."""

    type: Literal["answer"] = "answer"
    problem: str = ""
    settings: InstrumentRecord | None = None


class ControlSocket:
    """The open socket, a context manager that removes it on exit.

    ``path``: a stale socket is replaced; the folder is created if missing. Raises StreamError if another program serves
    the socket, or it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self._listener = UnixListener(path, 0o660)
        self._listener.socket.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.remove()
        self._listener.socket.close()

    async def serve(
        self,
        status: Callable[[], ClientStatus],
        handle_request: Callable[[bytes], Awaitable[AtmosphereResponse]],
    ) -> NoReturn:
        """Accept connections, for ever."""
        loop = asyncio.get_running_loop()
        listener = self._listener.socket
        connections: set[asyncio.Task[None]] = set()

        def accept() -> None:
            with suppress(OSError):  # the client is gone already
                connection, _ = listener.accept()
                if len(connections) >= MAX_CONNECTIONS:
                    connection.close()
                    return
                connection.setblocking(False)
                task = group.create_task(_serve_connection(connection, status, handle_request))
                connections.add(task)
                task.add_done_callback(connections.discard)
                task.add_done_callback(lambda _: connection.close())

        async with asyncio.TaskGroup() as group:
            loop.add_reader(listener, accept)
            try:
                await asyncio.Event().wait()
            finally:
                loop.remove_reader(listener)
        raise AssertionError  # unreachable


async def _serve_connection(
    connection: socket,
    status: Callable[[], ClientStatus],
    handle_request: Callable[[bytes], Awaitable[AtmosphereResponse]],
) -> None:
    loop = asyncio.get_running_loop()
    with suppress(OSError):  # the client is gone, or sends nothing: TimeoutError
        async with asyncio.timeout(REQUEST_TIMEOUT_S):
            await loop.sock_sendall(connection, encode_line(status()) + b"\n")
            line = await _receive_line(connection)
        if line:
            response = await handle_request(line)
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                await loop.sock_sendall(connection, encode_line(response) + b"\n")


async def _receive_line(connection: socket) -> bytes:
    """Return the data up to the first line end, the end of the stream, or the size limit."""
    loop = asyncio.get_running_loop()
    received = b""
    while b"\n" not in received and len(received) < MAX_REQUEST_BYTES:
        data = await loop.sock_recv(connection, MAX_REQUEST_BYTES)
        if not data:
            break
        received += data
    return received.partition(b"\n")[0]
