"""The simulated instrument of another process: what goes wrong between the two."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.config import ScenarioConfig
from tsgt.errors import InstrumentError
from tsgt.simulation.clocks import VirtualClock
from tsgt.simulation.instrument import SimulatedInstrument
from tsgt.simulation.instrument_socket import InstrumentServer, RemoteInstrument
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from pathlib import Path

SCENARIO = ScenarioConfig()


def instrument() -> SimulatedInstrument:
    """Make a simulated instrument."""
    world = scenario_world(SCENARIO, 10.0, np.random.default_rng(1))
    return SimulatedInstrument(
        SCENARIO.stations[0], SCENARIO, world, VirtualClock(0), np.random.default_rng(2)
    )


async def test_without_a_server_there_is_no_instrument(tmp_path: Path) -> None:
    """The error names the socket."""
    remote = RemoteInstrument(tmp_path / "i.sock")
    with pytest.raises(InstrumentError, match=r"i\.sock: no simulated instrument answers"):
        await remote.connect()
    with pytest.raises(InstrumentError, match="call connect first"):
        await remote.track(1)


async def test_a_server_that_ends_is_noticed_and_found_again(tmp_path: Path) -> None:
    """A reading under way fails; when the server is back, connecting works."""
    path = tmp_path / "i.sock"
    remote = RemoteInstrument(path)
    async with InstrumentServer(path, instrument()):
        await remote.connect()
        await remote.track(1)
        await remote.read()
        reading = asyncio.create_task(remote.read())
        await asyncio.sleep(0.01)
    with pytest.raises(InstrumentError, match="is gone"):
        await reading
    with pytest.raises(InstrumentError, match="is gone"):
        await remote.direct()
    async with InstrumentServer(path, instrument()):
        await remote.connect()
        await remote.track(1)
        await remote.read()
        await remote.close()


async def test_the_last_client_has_the_instrument(tmp_path: Path) -> None:
    """A client that was started again need not wait until its predecessor is seen to be gone."""
    path = tmp_path / "i.sock"
    old, new = RemoteInstrument(path), RemoteInstrument(path)
    async with InstrumentServer(path, instrument()):
        await old.connect()
        await old.track(1)
        await new.connect()
        await new.track(2)
        assert (await new.read()).prism == 2
        with pytest.raises(InstrumentError, match="is gone"):
            await old.direct()
        await old.close()
        await new.close()


async def test_a_reader_that_sleeps_gets_the_newest(tmp_path: Path) -> None:
    """Readings that nobody takes do not pile up for ever."""
    path = tmp_path / "i.sock"
    remote = RemoteInstrument(path)
    async with InstrumentServer(path, instrument()):
        await remote.connect()
        await remote.track(1)
        await asyncio.sleep(100.0)
        first = await remote.read()
        assert VirtualClock(0).monotonic_ns() - first.at_ns < 7_000_000_000
        await remote.close()


@pytest.mark.parametrize("line", [b"nonsense\n", b'{"type":"tell","command":"explode"}\n'])
async def test_nonsense_ends_the_connection(tmp_path: Path, line: bytes) -> None:
    """The server drops who says what no client says, and serves the next one."""
    path = tmp_path / "i.sock"
    async with InstrumentServer(path, instrument()):
        reader, writer = await asyncio.open_unix_connection(path)
        writer.write(line)
        assert await reader.read() == b""
        writer.close()
        remote = RemoteInstrument(path)
        await remote.connect()
        await remote.close()


def test_a_client_needs_no_scipy() -> None:
    """What a simulated client loads is as small as what a client in the field does."""
    program = """
import sys
import tsgt.cli.composition, tsgt.cli.daemons, tsgt.config, tsgt.station.daemon
import tsgt.simulation.air_client, tsgt.simulation.chip, tsgt.simulation.hal, tsgt.simulation.instrument_socket
sys.exit(" ".join({"scipy", "matplotlib"} & set(sys.modules)) or 0)
"""
    subprocess.run([sys.executable, "-c", program], check=True)
