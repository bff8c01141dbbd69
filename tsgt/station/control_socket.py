"""The socket on which a station's client says how it does, and takes a request.

Whoever connects gets one JSON line, the status. Whoever then says something within a second gets a line that answers
it. Then the connection ends.

What people can ask of a running client over its status socket, and what it answers: one JSON line each.
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

PATIENCE_S = 1.0
"""Whoever only wants the status closes at once, or when the end comes."""

MAX_REQUEST_BYTES = 4096

MOST_TALKS = 32
"""More at a time are let go at once, so that file descriptors are left for instrument and radio."""


class StatusSocket:
    """The open socket; it is removed with the end of its block.

    Parameters
    ----------
    path
        Where. A stale one of an earlier run is replaced; its folder is created if need be.
    mode
        Its permissions.

    Raises
    ------
    StreamError
        Another program serves the socket, or it cannot be made.
    """

    def __init__(self, path: Path, *, mode: int = 0o660) -> None:
        self._listener = UnixListener(path, mode)
        self._listener.socket.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.remove()
        self._listener.socket.close()

    async def keep_answering(
        self, status: Callable[[], ClientStatus], request: Callable[[bytes], Awaitable[Answer]]
    ) -> NoReturn:
        """Let everybody in, for ever.

        Parameters
        ----------
        status
            Makes the first line.
        request
            Does what a line asks for.
        """
        loop = asyncio.get_running_loop()
        listener = self._listener.socket
        talking: set[asyncio.Task[None]] = set()

        def let_in() -> None:
            with suppress(OSError):  # who asked is gone already
                connection, _ = listener.accept()
                if len(talking) >= MOST_TALKS:
                    connection.close()
                    return
                connection.setblocking(False)
                talk = talks.create_task(_talk(connection, status, request))
                talking.add(talk)
                talk.add_done_callback(talking.discard)
                talk.add_done_callback(lambda _: connection.close())

        async with asyncio.TaskGroup() as talks:
            loop.add_reader(listener, let_in)
            try:
                await asyncio.Event().wait()
            finally:
                loop.remove_reader(listener)
        raise AssertionError  # which nobody reaches


async def _talk(
    connection: socket, status: Callable[[], ClientStatus], request: Callable[[bytes], Awaitable[Answer]]
) -> None:
    loop = asyncio.get_running_loop()
    with suppress(OSError):  # whoever asked is gone, or says nothing, which is a TimeoutError
        async with asyncio.timeout(PATIENCE_S):
            await loop.sock_sendall(connection, encode_line(status()) + b"\n")
            line = await _line(connection)
        if line:
            answer = await request(line)
            async with asyncio.timeout(PATIENCE_S):
                await loop.sock_sendall(connection, encode_line(answer) + b"\n")


async def _line(connection: socket) -> bytes:
    """Return what comes up to the first line end, the end, or the limit."""
    loop = asyncio.get_running_loop()
    received = b""
    while b"\n" not in received and len(received) < MAX_REQUEST_BYTES:
        data = await loop.sock_recv(connection, MAX_REQUEST_BYTES)
        if not data:
            break
        received += data
    return received.partition(b"\n")[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class AtmosphereRequest:
    """The instrument is to correct distances for this air from now on.

    Attributes
    ----------
    type
        Always ``atmosphere``.
    temperature_c, pressure_hpa
        As in :class:`~tsgt.station.instrument.Atmosphere`.
    """

    type: Literal["atmosphere"] = "atmosphere"
    temperature_c: TemperatureC
    pressure_hpa: PressureHpa


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What became of a request.

    Attributes
    ----------
    type
        Always ``answer``.
    problem
        Why it was not done, or not yet; empty when it was.
    settings
        What is known of the instrument and of its settings now, as read back from it; null where nothing is.
    """

    type: Literal["answer"] = "answer"
    problem: str = ""
    settings: InstrumentRecord | None = None
