"""A Leica driver on a simulated line to a simulated total station, in virtual time."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from tsgt.config import (
    InstrumentModelConfig,
    LeicaInstrumentConfig,
    MotionConfig,
    ScenarioConfig,
    SimulatedStation,
)
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.world import scenario_world
from tsgt.station.leica import LeicaInstrument

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Sequence

    from tsgt.config.scenario import StatusFaultConfig
    from tsgt.model import Status
    from tsgt.simulation.kernel.event_loop import VirtualEventLoop
    from tsgt.station import Reading

TARGETS_M = ((20.0, 5.0, 0.5),)


@dataclass(frozen=True)
class LeicaBench:
    """The driver, its line, the simulated instrument, and the host's clock, which shows true time."""

    instrument: LeicaInstrument
    station: SimulatedTotalStation
    line: SimulatedLine
    clock: VirtualClock

    @property
    def now_s(self) -> float:
        """True time."""
        return self.clock.monotonic_ns() / 1e9

    async def begin(self, prism: int = 1) -> None:
        """Connect and track."""
        await self.instrument.connect()
        await self.instrument.track(prism)

    async def read_for(self, seconds: float) -> list[Reading]:
        """Return all readings within a duration."""
        readings = []
        until_s = self.now_s + seconds
        while True:
            try:
                async with asyncio.timeout(until_s - self.now_s):
                    readings.append(await self.instrument.read())
            except TimeoutError:
                return readings

    async def read_until(self, status: Status, *, within_s: float) -> Reading:
        """Return the first reading with a status."""
        async with asyncio.timeout(within_s):
            while True:
                reading = await self.instrument.read()
                if reading.status is status:
                    return reading


def leica_config(**changes: Any) -> LeicaInstrumentConfig:
    """Return a configuration with the prism constant 0."""
    settings: dict[str, Any] = {"prism_type": "user", "prism_constant_mm": 0.0} | changes
    return LeicaInstrumentConfig(kind="leica", port=Path("/dev/ttyUSB0"), **settings)


@asynccontextmanager
async def leica_bench(
    config: LeicaInstrumentConfig | None = None,
    *,
    faults: Sequence[StatusFaultConfig] = (),
    rate_hz: float = 2.5,
    model: InstrumentModelConfig | None = None,
    seed: int = 2,
    duration_s: float = 300.0,
    motion: MotionConfig | None = None,
) -> AsyncGenerator[LeicaBench]:
    """Set up a disconnected driver for the duration of the block."""
    stations = tuple(
        SimulatedStation(
            station=number,
            prism=number,
            position_m=position_m,
            rate_hz=rate_hz,
            instrument=model or InstrumentModelConfig(),
        )
        for number, position_m in ((1, (0.0, 0.0, 0.0)), (2, (2.0, -1.5, 0.1)), (3, (-1.5, 2.5, -0.2)))
    )
    scenario = ScenarioConfig(
        stations=stations, targets_m=TARGETS_M, faults=tuple(faults), motion=motion or MotionConfig()
    )
    world = scenario_world(scenario, duration_s, np.random.default_rng(1))
    timeline = cast("VirtualEventLoop", asyncio.get_running_loop())._timeline
    clock = VirtualClock(0)
    station = SimulatedTotalStation(
        scenario.stations[0], scenario, world, timeline, np.random.default_rng(seed)
    )
    line = SimulatedLine(station, timeline, clock)
    instrument = LeicaInstrument(config or leica_config(), line.open, clock)
    try:
        yield LeicaBench(instrument, station, line, clock)
    finally:
        await instrument.close()
