"""Connection of a simulated radio to the channel of other processes: see :mod:`tsgt.simulation.lora.air_server`."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, NoReturn, Self

import numpy as np
import structlog

from tsgt.errors import StreamError
from tsgt.recording import encode_line
from tsgt.simulation.lora.air import Air
from tsgt.simulation.lora.air_messages import (
    FrameMessage,
    FromClient,
    FromServer,
    Incoming,
    Join,
    Left,
    LineBuffer,
    Rejected,
    Stop,
    Stopped,
    Transmit,
    Welcome,
    decode_from_server,
)
from tsgt.simulation.lora.link import LinkModel

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.lora.air import Transceiver
    from tsgt.simulation.lora.frames import (
        AirPort,
        Frame,
        FrameListener,
        Header,
        Modulation,
        ReceiverSettings,
        Reception,
    )

WELCOME_TIMEOUT_S = 5.0
"""Timeout of the server's response to a join."""

log = structlog.get_logger()


class AirClient:
    """One radio's connection to an air server; an async context manager.

    Raises
    ------
    StreamError
        On entering: no server on this socket, or it rejects the radio.
    """

    def __init__(self, path: Path, name: str, timeline: Timeline, *, crystal_ppm: float = 0.0) -> None:
        self._path = path
        self._name = name
        self._timeline = timeline
        self._crystal_ppm = crystal_ppm
        self._losses = _ServerPathLoss()
        self._senders: dict[str, Transceiver] = {}
        self._radio: Transceiver | None = None

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._welcomed: asyncio.Future[None] = loop.create_future()
        self._disconnected: asyncio.Future[str] = loop.create_future()
        try:
            _, self._connection = await loop.create_unix_connection(
                lambda: _Connection(self._received, self._disconnect), os.fspath(self._path)
            )
        except OSError as error:
            raise StreamError(f"{self._path}: no air server ({error.strerror}); start one") from error
        try:
            self._connection.send(Join(name=self._name, crystal_ppm=self._crystal_ppm))
            await asyncio.wait(
                (self._welcomed, self._disconnected),
                timeout=WELCOME_TIMEOUT_S,
                return_when=asyncio.FIRST_COMPLETED,
            )
            if not self._welcomed.done():
                self._disconnect("the server does not respond")
                await self.wait_disconnected()
        except BaseException:
            await self._connection.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        if not self._disconnected.done():
            self._disconnected.set_result("closed by the client")
        await self._connection.close()

    def join(self, listener: FrameListener) -> AirPort:
        """Connect the radio's chip; only once."""
        self._radio = self._air.join(listener, self._name, crystal_ppm=self._crystal_ppm)
        return _RemotePort(self._radio, self._connection)

    async def wait_disconnected(self) -> NoReturn:
        """Wait until the connection is lost; then the radio neither sends nor receives.

        Raises
        ------
        StreamError
            When it is lost, with the reason.
        """
        reason = await asyncio.shield(self._disconnected)
        raise StreamError(
            f"{self._path}: radio {self._name!r} is disconnected from the simulated channel: {reason}"
        )

    def _disconnect(self, reason: str) -> None:
        if self._disconnected.done():
            return
        self._disconnected.set_result(reason)
        if self._radio is not None:
            self._radio.listen(None)
            log.error("air_lost", name=self._name, reason=reason)

    def _received(self, line: FromServer) -> None:
        if isinstance(line, Rejected):
            self._disconnect(line.reason)
        elif not self._welcomed.done():
            if not isinstance(line, Welcome):
                raise ValueError("the first message is not a welcome")  # noqa: TRY004 (invalid input)
            self._link = LinkModel(path_loss=self._losses, noise_figure_db=line.noise_figure_db)
            self._air = Air(self._timeline, np.random.default_rng(line.seed), self._link)
            self._welcomed.set_result(None)
        elif isinstance(line, Incoming):
            self._losses.losses_db[line.sender] = line.loss_db
            self._link.loss_probability = line.loss_probability
            self._sender(line.sender, line.crystal_ppm).transmit(line.frame.frame())
        elif isinstance(line, Stopped):
            if (sender := self._senders.get(line.sender)) is not None:
                sender.stop_transmitting(line.at_ns)
        elif isinstance(line, Left) and self._senders.pop(line.sender, None) is not None:
            self._air.leave(line.sender)

    def _sender(self, name: str, crystal_ppm: float) -> Transceiver:
        if name not in self._senders:
            self._senders[name] = self._air.join(_NullListener(), name, crystal_ppm=crystal_ppm)
        return self._senders[name]


class _ServerPathLoss:
    """Path loss from each sender to this radio, as reported by the server."""

    def __init__(self) -> None:
        self.losses_db: dict[str, float] = {}

    def loss_db(self, sender: str, receiver: str, frequency_hz: float) -> float:  # noqa: ARG002 (of the protocol)
        return self.losses_db[sender]


class _NullListener:
    """Listener of the remote senders, whose receivers are in their own processes."""

    def preamble_detected(self, at_ns: int) -> None:
        raise NotImplementedError

    def header_received(self, at_ns: int, header: Header) -> None:
        raise NotImplementedError

    def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
        raise NotImplementedError


class _RemotePort:
    """A port with a local receiver and a remote sender."""

    def __init__(self, receiver: Transceiver, connection: _Connection) -> None:
        self._receiver = receiver
        self._connection = connection

    def transmit(self, frame: Frame) -> None:
        self._connection.send(Transmit(frame=FrameMessage.of(frame)))

    def stop_transmitting(self, at_ns: int) -> None:
        self._connection.send(Stop(at_ns=at_ns))

    def listen(self, listening: ReceiverSettings | None) -> None:
        self._receiver.listen(listening if self._connection.is_open else None)

    def rssi_dbm(self, at_ns: int) -> float:
        return self._receiver.rssi_dbm(at_ns)

    def preamble_present(self, modulation: Modulation, at_ns: int) -> bool:
        return self._receiver.preamble_present(modulation, at_ns)


class _Connection(asyncio.Protocol):
    """Message stream to and from the server; reports the first reason of disconnection."""

    transport: asyncio.WriteTransport

    def __init__(self, received: Callable[[FromServer], None], disconnect: Callable[[str], None]) -> None:
        self._received = received
        self._disconnect = disconnect
        self._lines = LineBuffer()
        self._closed: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    @property
    def is_open(self) -> bool:
        return not self.transport.is_closing()

    def send(self, line: FromClient) -> None:
        if self.is_open:
            self.transport.write(encode_line(line) + b"\n")

    async def close(self) -> None:
        self.transport.close()
        await self._closed

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)  # noqa: S101 (asyncio's promise for a stream socket)
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        try:
            for line in self._lines.lines(data):
                self._received(decode_from_server(line))
        except ValueError as error:
            self._abort(f"invalid message from the server ({error})")

    def pause_writing(self) -> None:
        self._abort("the server does not read")

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (of asyncio)
        self._disconnect("the server has closed the connection")
        self._closed.set_result(None)

    def _abort(self, reason: str) -> None:
        self._disconnect(reason)
        self.transport.abort()
