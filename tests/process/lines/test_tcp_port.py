"""The TCP line to an instrument: real sockets on this computer."""

from __future__ import annotations

import asyncio
import socket
from contextlib import asynccontextmanager
from functools import wraps
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.instruments.leica import leica_config
from harness.instruments.tcp_line import TcpLine

from tsgt.clock import SystemClock
from tsgt.config import ScenarioConfig, TcpAddress
from tsgt.errors import InstrumentError
from tsgt.simulation.instrument import SimulatedTotalStation
from tsgt.simulation.kernel import LoopTimeline
from tsgt.simulation.world import scenario_world
from tsgt.station.leica import LeicaInstrument
from tsgt.station.serial import tcp_port
from tsgt.station.serial.tcp_port import open_tcp_port

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine

    from tsgt.station.serial import Port


def in_real_time(test: Callable[..., Coroutine[None, None, None]]) -> Callable[..., None]:
    """Run a coroutine test on a real event loop."""

    @wraps(test)
    def run(**fixtures: object) -> None:
        asyncio.run(test(**fixtures))

    return run


@asynccontextmanager
async def server(
    serve: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]],
) -> AsyncGenerator[TcpAddress]:
    """Run a server on a free port."""
    running = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with running:
        yield TcpAddress("127.0.0.1", running.sockets[0].getsockname()[1])


async def opened(address: TcpAddress) -> Port:
    """Open a line."""
    return await open_tcp_port(address, SystemClock())


async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Return what arrives."""
    while data := await reader.read(1000):
        writer.write(data)
    writer.close()


async def read_for_ever(instrument: LeicaInstrument) -> None:
    """Read until the line is lost."""
    while True:
        await instrument.read()


@in_real_time
async def test_bytes_go_both_ways() -> None:
    """Unread data can be dropped, and closing resets the connection, so that no old request is delivered later."""
    ended: asyncio.Future[BaseException | None] = asyncio.get_running_loop().create_future()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await echo(reader, writer)
            ended.set_result(None)
        except OSError as error:
            ended.set_result(error)
        finally:
            writer.close()

    async with server(serve) as address:
        port = await opened(address)
        port.write(b"one")
        assert (await port.read()).data == b"one"
        assert port.drain() == b""
        await port.close()
        with pytest.raises(InstrumentError, match="closed"):
            port.write(b"two")
        assert isinstance(await ended, ConnectionResetError)


@in_real_time
async def test_connection_has_keepalive_and_no_delay() -> None:
    """A dead connection is noticed where nothing is requested, and requests are sent at once."""
    async with server(echo) as address:
        port = await opened(address)
        link = port._transport.get_extra_info("socket")  # type: ignore[attr-defined]
        assert link.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert link.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert link.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 15_000
        await port.close()


@in_real_time
async def test_refused_connection_is_one_line() -> None:
    """Nothing listens."""
    async with server(echo) as address:
        pass
    with pytest.raises(
        InstrumentError, match=r"tcp://127\.0\.0\.1:\d+ cannot be connected: nothing listens there"
    ):
        await opened(address)


@in_real_time
async def test_unknown_name_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without waiting in the executor."""

    def fail(*_: object, **__: object) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", fail)
    with pytest.raises(InstrumentError, match="the name cannot be resolved"):
        await opened(TcpAddress("instrument.invalid", 1212))


@in_real_time
async def test_silent_host_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A name server that does not answer: the time-out covers it."""
    release = asyncio.Event()
    monkeypatch.setattr(tcp_port, "CONNECT_TIMEOUT_S", 0.05)

    async def wait(*_: object) -> None:
        await release.wait()

    monkeypatch.setattr(tcp_port, "_resolve", wait)
    with pytest.raises(InstrumentError, match="no answer within"):
        await opened(TcpAddress("instrument.invalid", 1212))


@in_real_time
async def test_server_that_closes_is_named() -> None:
    """At once: probably a second client. Later: the instrument has closed."""

    async def close(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.close()

    async def close_later(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"x")
        writer.close()

    async with server(close) as address:
        port = await opened(address)
        with pytest.raises(InstrumentError, match="another program may be connected"):
            await port.read()
        await port.close()
    async with server(close_later) as address:
        port = await opened(address)
        assert (await port.read()).data == b"x"
        with pytest.raises(InstrumentError, match="has closed the connection"):
            await port.read()
        await port.close()


@in_real_time
async def test_flood_is_not_kept() -> None:
    """A server that sends without end: reading pauses, and goes on when something was read."""

    async def flood(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for _ in range(64):
            writer.write(bytes(65_536))
        await writer.drain()
        writer.close()

    async with server(flood) as address:
        port = await opened(address)
        await asyncio.sleep(0.1)
        assert port._kept < 1_000_000  # type: ignore[attr-defined]
        received = 0
        while received < 64 * 65_536:
            received += len((await port.read()).data)
        await port.close()


@in_real_time
async def test_simulated_instrument_is_measured_over_tcp() -> None:
    """The whole driver over a real socket, with delays added; a second client is turned away."""
    scenario, clock = ScenarioConfig(), SystemClock()
    world = scenario_world(scenario, 60.0, np.random.default_rng(1))
    timeline = LoopTimeline(asyncio.get_running_loop())
    station = SimulatedTotalStation(scenario.stations[0], scenario, world, timeline, np.random.default_rng(2))
    async with TcpLine(station, clock, np.random.default_rng(3)) as line:
        address = TcpAddress("127.0.0.1", line.port)
        config = leica_config().model_copy(update={"port": address})

        async def open_port(_: int) -> Port:
            return await open_tcp_port(address, clock)

        instrument, second = (LeicaInstrument(config, open_port, clock) for _ in range(2))
        assert "230001" in await instrument.connect()
        with pytest.raises(InstrumentError, match="another program may be connected"):
            await second.connect()
        await instrument.track(1)
        async with asyncio.timeout(20.0):
            while not (await instrument.read()).status.usable:
                pass
            line.drop()
            with pytest.raises(InstrumentError, match=r"the connection is lost|has closed"):
                await read_for_ever(instrument)
        await instrument.close()
