"""A simulated total station in virtual time, and a terminal that sends it GeoCOM requests."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.config import MotionConfig, NoiseConfig, ScenarioConfig
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.kernel.event_loop import VirtualEventLoop
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from tsgt.simulation.kernel import VirtualTimeline
    from tsgt.simulation.world import World
    from tsgt.station.serial import Chunk, Port

SILENT = NoiseConfig(range_sigma_mm=0.0, range_sigma_ppm=0.0, angle_sigma_arcsec=0.0, pointing_sigma_mm=0.0)

STANDING = MotionConfig(speeds_mps=(0.0,), speed_weights=(1.0,))


class RawReply(NamedTuple):
    """A reply with its values as text, and the chunk that ended it."""

    com_code: int
    transaction: int
    code: int
    values: list[str]
    chunk: Chunk


class Bench:
    """An instrument, its cable, and a terminal; without a world, that of the scenario for ``duration_s``."""

    def __init__(
        self,
        scenario: ScenarioConfig | None = None,
        *,
        seed: int = 2,
        station: int = 1,
        duration_s: float = 100.0,
        world: World | None = None,
    ) -> None:
        self.scenario = scenario or ScenarioConfig(motion=STANDING)
        self.timeline = virtual_timeline()
        self.world = world or scenario_world(self.scenario, duration_s, np.random.default_rng(1))
        self.instrument = SimulatedTotalStation(
            self.scenario.stations[station - 1],
            self.scenario,
            self.world,
            self.timeline,
            np.random.default_rng(seed),
        )
        self.line = SimulatedLine(self.instrument, self.timeline, VirtualClock(0), name="the line")
        self.port: Port | None = None
        self._asked = 0

    async def ask(self, rpc: int, *parameters: object) -> RawReply:
        """Send a request and return its reply."""
        self._asked += 1
        text = ",".join(str(parameter) for parameter in parameters)
        reply = await self.type(f"%R1Q,{rpc},{self._asked}:{text}\r\n".encode())
        assert reply.transaction == self._asked
        return reply

    async def type(self, data: bytes) -> RawReply:
        """Send data and return the next line."""
        await self.send(data)
        return await self.listen()

    async def send(self, data: bytes) -> None:
        """Send data; open the port if necessary."""
        if self.port is None:
            self.port = await self.line.open(self.instrument.baud)
        self.port.write(data)

    async def listen(self) -> RawReply:
        """Return the next line."""
        assert self.port is not None
        line = b""
        async with asyncio.timeout(100):
            while not line.endswith(b"\r\n"):
                chunk = await self.port.read()
                line += chunk.data
        head, _, tail = line.decode().strip().partition(":")
        _, com_code, transaction = head.split(",")[:3]
        code, *values = tail.split(",")
        return RawReply(int(com_code), int(transaction), int(code), values, chunk)

    async def code(self, rpc: int, *parameters: object) -> int:
        """Send a request and return its code."""
        return (await self.ask(rpc, *parameters)).code

    async def do(self, *requests: tuple[object, ...]) -> None:
        """Send requests, all of which must succeed."""
        for rpc, *parameters in requests:
            assert isinstance(rpc, int)
            reply = await self.ask(rpc, *parameters)
            assert (reply.com_code, reply.code) == (0, 0), (rpc, parameters, reply)

    async def quiet(self, seconds: float) -> bool:
        """Return whether nothing arrives for a duration."""
        assert self.port is not None
        try:
            async with asyncio.timeout(seconds):
                await self.port.read()
        except TimeoutError:
            return True
        return False


def virtual_timeline() -> VirtualTimeline:
    """Return the timeline of the running loop."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualEventLoop)
    return loop._timeline


def with_station(scenario: ScenarioConfig | None = None, **changes: object) -> ScenarioConfig:
    """Change all stations of a scenario alike; ``instrument`` may be a dictionary."""
    scenario = scenario or ScenarioConfig(motion=STANDING)
    instrument = changes.pop("instrument", {})
    assert isinstance(instrument, dict)
    stations = tuple(
        entry.model_copy(update={**changes, "instrument": entry.instrument.model_copy(update=instrument)})
        for entry in scenario.stations
    )
    return scenario.model_copy(update={"stations": stations})


SETUP: tuple[tuple[object, ...], ...] = ((2008, 3, 1), (17008, 9), (2024, 0.0), (2020, 9), (2008, 1, 1))
"""Requests for continuous measurements with the prism constant 0, from any state."""
