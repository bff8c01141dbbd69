"""One radio channel for simulated radios in several processes, in real time, over a UNIX socket.

Problem: a chip queries its receiver synchronously (RSSI, channel activity), and the delay of a message must not affect
the result. Idea: the server only forwards transmissions and their path loss; each client keeps an
:class:`~tsgt.simulation.lora.air.Air` of its own, in which the other processes' radios are senders only. All times are
CLOCK_MONOTONIC of the machine and travel with the messages, so that the same model decides as within one process. A
delayed message delays events but does not change them.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from typing import TYPE_CHECKING, Self

import structlog

from tsgt.recording import encode_line
from tsgt.service import UnixListener
from tsgt.simulation.lora.air_messages import (
    FromClient,
    FromServer,
    Incoming,
    Join,
    Left,
    LineBuffer,
    Rejected,
    Stopped,
    Transmit,
    Welcome,
    decode_from_client,
)
from tsgt.simulation.lora.link import uniform_draws

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np

    from tsgt.simulation.lora.link import LinkModel

MODE = 0o600
"""Only processes of the same user may connect."""

MAX_WAITING_BYTES = 1 << 20
"""A client with more unread bytes is disconnected."""

_MAX_START_OFFSET_NS = 1_000_000_000

_ANY_FREQUENCY_HZ = 868e6

log = structlog.get_logger()


class AirServer:
    """Forwards frames between the connected processes; an async context manager.

    Path loss, fading and packet loss of ``link`` may be changed at any time; ``now_ns`` returns CLOCK_MONOTONIC.

    Raises
    ------
    StreamError
        On entering: another program serves the socket, or it cannot be created.
    """

    def __init__(
        self,
        path: Path,
        link: LinkModel,
        rng: np.random.Generator,
        *,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.link = link
        self._path = path
        self._seed = int(rng.integers(2**63))
        self._now_ns = now_ns
        self._sent: Counter[str] = Counter()
        self._connections: set[_Connection] = set()
        self._members: dict[str, _Connection] = {}

    async def __aenter__(self) -> Self:
        self._listener = UnixListener(self._path, MODE)
        loop = asyncio.get_running_loop()
        self._server = await loop.create_unix_server(lambda: _Connection(self), sock=self._listener.socket)
        log.info("air_opened", path=str(self._path))
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self._listener.remove()
        closed = [connection.closed for connection in self._connections]
        for connection in list(self._connections):
            connection.transport.abort()
        await asyncio.gather(*closed)

    @property
    def radio_names(self) -> set[str]:
        """Names of the radios that have joined."""
        return set(self._members)

    def connected(self, connection: _Connection) -> None:
        """Add a connection, which has yet to join."""
        self._connections.add(connection)

    def disconnected(self, connection: _Connection) -> None:
        """Remove a radio and cut its frame."""
        self._connections.discard(connection)
        if connection.name is not None:
            del self._members[connection.name]
            self._broadcast(connection, Left(sender=connection.name))
            log.info("air_left", name=connection.name)

    def received(self, connection: _Connection, line: FromClient) -> None:
        """Process a client's message; raise ValueError if it is out of order."""
        if isinstance(line, Join):
            self._join(connection, line)
        elif connection.name is None:
            raise ValueError("the first message must be of type 'join'")
        elif isinstance(line, Transmit):
            self._transmit(connection, connection.name, line)
        else:
            self._broadcast(connection, Stopped(sender=connection.name, at_ns=line.at_ns))

    def _join(self, connection: _Connection, line: Join) -> None:
        if connection.name is not None:
            raise ValueError(f"this connection has joined as {connection.name!r} already")
        if line.name in self._members:
            raise ValueError(f"radio {line.name!r} has joined already; each radio needs a unique name")
        # Without this check, the first frame towards an unknown name would disconnect its sender.
        self.link.path_loss.loss_db(line.name, line.name, _ANY_FREQUENCY_HZ)
        connection.name = line.name
        connection.crystal_ppm = line.crystal_ppm
        self._members[line.name] = connection
        connection.send(Welcome(seed=self._seed, noise_figure_db=self.link.noise_figure_db))
        log.info("air_joined", name=line.name)

    def _transmit(self, sender: _Connection, name: str, line: Transmit) -> None:
        if abs(line.frame.start_ns - self._now_ns()) > _MAX_START_OFFSET_NS:
            raise ValueError("the frame's start is not now; times are CLOCK_MONOTONIC in ns")
        self._sent[name] += 1
        for receiver, connection in list(self._members.items()):
            if connection is not sender:
                draws = uniform_draws(self._seed, name, self._sent[name], receiver)
                incoming = Incoming(
                    sender=name,
                    crystal_ppm=sender.crystal_ppm,
                    loss_db=self.link.loss_db(name, receiver, line.frame.frequency_hz, draws),
                    loss_probability=self.link.loss_probability,
                    frame=line.frame,
                )
                connection.send(incoming)

    def _broadcast(self, connection: _Connection, line: Stopped | Left) -> None:
        for other in list(self._members.values()):
            if other is not connection:
                other.send(line)


class _Connection(asyncio.Protocol):
    """One client's connection."""

    transport: asyncio.WriteTransport

    def __init__(self, server: AirServer) -> None:
        self.name: str | None = None
        self.crystal_ppm = 0.0
        self.closed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._server = server
        self._lines = LineBuffer()

    def send(self, line: FromServer) -> None:
        if not self.transport.is_closing():
            self.transport.write(encode_line(line) + b"\n")

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)  # noqa: S101 (asyncio's promise for a stream socket)
        transport.set_write_buffer_limits(high=MAX_WAITING_BYTES)
        self.transport = transport
        self._server.connected(self)

    def data_received(self, data: bytes) -> None:
        try:
            for line in self._lines.lines(data):
                self._server.received(self, decode_from_client(line))
        except ValueError as error:
            self._reject(str(error))

    def pause_writing(self) -> None:
        log.warning("air_client_dropped", name=self.name, reason="it does not read")
        self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (of asyncio)
        self._server.disconnected(self)
        self.closed.set_result(None)

    def _reject(self, reason: str) -> None:
        log.warning("air_client_dropped", name=self.name, reason=reason)
        self.send(Rejected(reason=reason))
        self.transport.close()
