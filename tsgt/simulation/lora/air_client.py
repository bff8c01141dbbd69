"""A simulated radio's way to the air of other processes: see :mod:`tsgt.simulation.lora.air_server`."""

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
    FrameLine,
    FromClient,
    FromServer,
    Incoming,
    Join,
    Left,
    LineBuffer,
    Refused,
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
    from tsgt.simulation.lora.frames import Antenna, Frame, Header, Listening, Modulation, Port, Reception

WELCOME_TIMEOUT_S = 5.0
"""How long a server may take to answer; it has nothing else to do."""

log = structlog.get_logger()


class AirClient:
    """One radio's connection to an air server; an async context manager.

    Parameters
    ----------
    path
        The server's socket.
    name
        The radio's name in the server's link model.
    timeline
        CLOCK_MONOTONIC, the chip's timeline as well.
    crystal_ppm
        How far the radio's carrier and receiver lie above what they are set to.

    Raises
    ------
    StreamError
        On entering: nobody serves the socket, or the server refuses the radio.
    """

    def __init__(self, path: Path, name: str, timeline: Timeline, *, crystal_ppm: float = 0.0) -> None:
        self._path = path
        self._name = name
        self._timeline = timeline
        self._crystal_ppm = crystal_ppm
        self._losses = _Losses()
        self._senders: dict[str, Transceiver] = {}
        self._radio: Transceiver | None = None

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._welcomed: asyncio.Future[None] = loop.create_future()
        self._lost: asyncio.Future[str] = loop.create_future()
        try:
            _, self._connection = await loop.create_unix_connection(
                lambda: _Connection(self._received, self._lose), os.fspath(self._path)
            )
        except OSError as error:
            raise StreamError(f"{self._path}: no air server answers ({error.strerror}); start one") from error
        try:
            self._connection.send(Join(name=self._name, crystal_ppm=self._crystal_ppm))
            await asyncio.wait(
                (self._welcomed, self._lost),
                timeout=WELCOME_TIMEOUT_S,
                return_when=asyncio.FIRST_COMPLETED,
            )
            if not self._welcomed.done():
                self._lose("the server does not answer")
                await self.wait_lost()
        except BaseException:
            await self._connection.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        if not self._lost.done():
            self._lost.set_result("it has been left")
        await self._connection.close()

    def join(self, antenna: Antenna) -> Port:
        """Connect the radio's chip; it can be done once."""
        self._radio = self._air.join(antenna, self._name, crystal_ppm=self._crystal_ppm)
        return _RemotePort(self._radio, self._connection)

    async def wait_lost(self) -> NoReturn:
        """Wait until the server is gone, which leaves the radio deaf and dumb.

        Raises
        ------
        StreamError
            Then, with the reason.
        """
        reason = await asyncio.shield(self._lost)
        raise StreamError(f"{self._path}: the simulated air is lost to radio {self._name!r}: {reason}")

    def _lose(self, reason: str) -> None:
        if self._lost.done():
            return
        self._lost.set_result(reason)
        if self._radio is not None:
            self._radio.listen(None)
            log.error("air_lost", name=self._name, reason=reason)

    def _received(self, line: FromServer) -> None:
        if isinstance(line, Refused):
            self._lose(line.reason)
        elif not self._welcomed.done():
            if not isinstance(line, Welcome):
                raise ValueError("it does not begin with a welcome")  # noqa: TRY004 (what came is at fault)
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
            self._senders[name] = self._air.join(_NoAntenna(), name, crystal_ppm=crystal_ppm)
        return self._senders[name]


class _Losses:
    """What the server says of the way from each sender to here."""

    def __init__(self) -> None:
        self.losses_db: dict[str, float] = {}

    def loss_db(self, sender: str, receiver: str, frequency_hz: float) -> float:  # noqa: ARG002 (the server knows)
        return self.losses_db[sender]


class _NoAntenna:
    """The other processes' radios listen there, not here."""

    def preamble_detected(self, at_ns: int) -> None:
        raise NotImplementedError

    def header_received(self, at_ns: int, header: Header) -> None:
        raise NotImplementedError

    def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
        raise NotImplementedError


class _RemotePort:
    """A port whose receiver is here and whose sender is with the server."""

    def __init__(self, receiver: Transceiver, connection: _Connection) -> None:
        self._receiver = receiver
        self._connection = connection

    def transmit(self, frame: Frame) -> None:
        self._connection.send(Transmit(frame=FrameLine.of(frame)))

    def stop_transmitting(self, at_ns: int) -> None:
        self._connection.send(Stop(at_ns=at_ns))

    def listen(self, listening: Listening | None) -> None:
        self._receiver.listen(listening if self._connection.is_open else None)

    def rssi_dbm(self, at_ns: int) -> float:
        return self._receiver.rssi_dbm(at_ns)

    def preamble_present(self, modulation: Modulation, at_ns: int) -> bool:
        return self._receiver.preamble_present(modulation, at_ns)


class _Connection(asyncio.Protocol):
    """Lines to and from the server; a reason for its end, once."""

    transport: asyncio.WriteTransport

    def __init__(self, received: Callable[[FromServer], None], lose: Callable[[str], None]) -> None:
        self._received = received
        self._lose = lose
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
            self._abort(f"the server says what no air server says ({error})")

    def pause_writing(self) -> None:
        self._abort("the server does not read")

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (it is gone in any case)
        self._lose("the server has closed the connection")
        self._closed.set_result(None)

    def _abort(self, reason: str) -> None:
        self._lose(reason)
        self.transport.abort()
