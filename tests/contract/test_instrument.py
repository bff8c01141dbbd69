"""What every instrument does, whatever is behind it: each test runs on all of them."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pytest
from support.bridge import ServedInstrument
from support.leica import LeicaBench, leica_bench

from tsgt.config import ScenarioConfig
from tsgt.config.client import BridgeInstrumentConfig
from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.simulation.clocks import VirtualClock
from tsgt.simulation.instrument import SimulatedInstrument
from tsgt.simulation.instrument_socket import InstrumentServer, RemoteInstrument
from tsgt.simulation.world import scenario_world
from tsgt.station.bridge import BridgeInstrument

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

    from tsgt.station.instrument import Instrument

PERIOD_NS = 400_000_000
SCENARIO = ScenarioConfig(targets_m=((20.0, 5.0, 0.5),))


class Hand(Protocol):
    """What a person does: pull the cable, and point at a target."""

    plugged: bool

    def aim(self, target: int | None) -> None:
        """Point at a foil target."""


@dataclass
class LeicaHand:
    """The same at a Leica instrument, which also has to be shown another prism."""

    day: LeicaBench

    @property
    def plugged(self) -> bool:
        """Whether the cable is in."""
        return self.day.line.plugged

    @plugged.setter
    def plugged(self, plugged: bool) -> None:
        self.day.line.plugged = plugged

    def aim(self, target: int | None) -> None:
        """Point at a foil target."""
        self.day.station.aim(target)


@dataclass(frozen=True)
class Bench:
    """The instrument under test, the hand at it, and how uneven its measurements are."""

    instrument: Instrument
    simulated: Hand
    name: str = "simulated total station 1"
    uneven_ns: int = 0

    def point_at(self, prism: int) -> None:
        """Point at another prism, where that takes a person."""
        if isinstance(self.simulated, LeicaHand):
            self.simulated.day.station.aim_at_prism(prism)


@asynccontextmanager
async def bench(kind: str, folder: Path) -> AsyncGenerator[Bench]:
    """Set up an instrument of one kind; it is not connected."""
    world = scenario_world(SCENARIO, 100.0, np.random.default_rng(1))
    simulated = SimulatedInstrument(
        SCENARIO.stations[0], SCENARIO, world, VirtualClock(0), np.random.default_rng(2)
    )
    if kind == "simulated":
        yield Bench(simulated, simulated)
        return
    if kind == "leica":
        async with leica_bench() as leica:
            yield Bench(leica.instrument, LeicaHand(leica), "Leica TCRP1201+ 230001", 40_000_000)
        return
    if kind == "bridge":
        config = BridgeInstrumentConfig(kind="bridge", command=("bridge",))
        bridge = BridgeInstrument(config, VirtualClock(0), ServedInstrument(simulated, VirtualClock(0)))
        try:
            yield Bench(bridge, simulated)
        finally:
            await bridge.close()
        return
    async with InstrumentServer(folder / "i.sock", simulated):
        remote = RemoteInstrument(folder / "i.sock")
        try:
            yield Bench(remote, simulated)
        finally:
            await remote.close()


@pytest.fixture(params=["simulated", "remote", "bridge", "leica"])
def kind(request: pytest.FixtureRequest) -> str:
    """Every kind of instrument."""
    name = request.param
    assert isinstance(name, str)
    return name


async def test_it_says_who_it_is(kind: str, tmp_path: Path) -> None:
    """Connecting returns a name for people, also the second time."""
    async with bench(kind, tmp_path) as day:
        assert (await day.instrument.connect()).startswith(day.name)
        await day.instrument.close()
        assert (await day.instrument.connect()).startswith(day.name)


async def test_readings_come_one_after_the_other(kind: str, tmp_path: Path) -> None:
    """While tracking, no reading comes twice, and the stamps lie in the past."""
    async with bench(kind, tmp_path) as day:
        await day.instrument.connect()
        await day.instrument.track(2)
        readings = [await day.instrument.read() for _ in range(10)]
        now_ns = VirtualClock(0).monotonic_ns()
    stamps = [reading.at_ns for reading in readings]
    assert np.diff(stamps) == pytest.approx([PERIOD_NS] * 9, rel=0, abs=day.uneven_ns)
    assert now_ns - PERIOD_NS < stamps[-1] <= now_ns
    assert {(reading.prism, reading.status.usable) for reading in readings} == {(2, True)}


async def test_a_reading_that_is_cancelled_takes_nothing_away(kind: str, tmp_path: Path) -> None:
    """Whoever gives up waiting gets that reading with the next call."""
    async with bench(kind, tmp_path) as day:
        await day.instrument.connect()
        await day.instrument.track(1)
        stamps = []
        for _ in range(40):
            try:
                async with asyncio.timeout(0.15):
                    stamps.append((await day.instrument.read()).at_ns)
            except TimeoutError:
                pass
    assert len(stamps) > 5
    assert np.diff(stamps) == pytest.approx([PERIOD_NS] * (len(stamps) - 1), rel=0, abs=day.uneven_ns)


async def test_another_prism_gives_readings_of_that_one(kind: str, tmp_path: Path) -> None:
    """After a change there is no reading of the old prism."""
    async with bench(kind, tmp_path) as day:
        await day.instrument.connect()
        await day.instrument.track(1)
        await day.instrument.read()
        await asyncio.sleep(1.0)
        await day.instrument.track(3)
        day.point_at(3)
        assert [(await day.instrument.read()).prism for _ in range(3)] == [3, 3, 3]


async def test_single_measurements(kind: str, tmp_path: Path) -> None:
    """In direct mode it measures what it is aimed at, and takes its time; without a target it says so."""
    async with bench(kind, tmp_path) as day:
        await day.instrument.connect()
        await day.instrument.track(1)
        await day.instrument.direct()
        before_ns = VirtualClock(0).monotonic_ns()
        nothing = await day.instrument.measure()
        day.simulated.aim(1)
        shot = await day.instrument.measure()
    assert (nothing.prism, nothing.status, nothing.slope_distance_m) == (None, Status.NO_TARGET, None)
    assert (shot.prism, shot.status) == (None, Status.OK)
    assert shot.slope_distance_m == pytest.approx(20.6216, abs=0.01)
    assert shot.at_ns - before_ns > 2_000_000_000


async def test_it_refuses_what_it_cannot_do(kind: str, tmp_path: Path) -> None:
    """An unknown prism, a single measurement while tracking, a reading while not: an error, and it goes on."""
    async with bench(kind, tmp_path) as day:
        await day.instrument.connect()
        if kind != "leica":  # which cannot know
            with pytest.raises(InstrumentError, match="no prism 9"):
                await day.instrument.track(9)
        await day.instrument.track(1)
        with pytest.raises(InstrumentError, match="call direct first"):
            await day.instrument.measure()
        await day.instrument.connect()
        await day.instrument.track(1)
        assert (await day.instrument.read()).status is Status.OK


async def test_a_pulled_cable_ends_the_reading(kind: str, tmp_path: Path) -> None:
    """Whoever waits gets an error; with the cable in again it can be connected again."""
    async with bench(kind, tmp_path) as day:
        await day.instrument.connect()
        await day.instrument.track(1)
        await day.instrument.read()
        day.simulated.plugged = False
        with pytest.raises(InstrumentError, match="plug"):
            await day.instrument.read()
        with pytest.raises(InstrumentError):
            await day.instrument.connect()
        day.simulated.plugged = True
        await day.instrument.connect()
        await day.instrument.track(1)
        await day.instrument.read()
