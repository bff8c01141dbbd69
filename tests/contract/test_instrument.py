"""The contract of every instrument: each test runs on all of them."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.instruments.bridge import ServedInstrument
from harness.instruments.leica import leica_bench

from tsgt.config import BridgeInstrumentConfig
from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.station.bridge import BridgeInstrument

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from harness.instruments.leica import LeicaBench

    from tsgt.station import Instrument

PERIOD_NS = 400_000_000
UNEVEN_NS = 40_000_000
NAME = "Leica TCRP1201+ 230001"


@dataclass(frozen=True)
class Bench:
    """The instrument under test, and the simulated one behind it with its cable."""

    instrument: Instrument
    far: LeicaBench


@asynccontextmanager
async def bench(kind: str) -> AsyncGenerator[Bench]:
    """Set up a disconnected instrument of one kind."""
    async with leica_bench() as far:
        if kind == "leica":
            yield Bench(far.instrument, far)
            return
        config = BridgeInstrumentConfig(kind="bridge", command=("bridge",))
        bridge = BridgeInstrument(config, far.clock, ServedInstrument(far.instrument, far.clock))
        try:
            yield Bench(bridge, far)
        finally:
            await bridge.close()


@pytest.fixture(params=["leica", "bridge"])
def kind(request: pytest.FixtureRequest) -> str:
    """Every kind of instrument."""
    name = request.param
    assert isinstance(name, str)
    return name


async def test_connect_returns_identity(kind: str) -> None:
    """Also the second time."""
    async with bench(kind) as day:
        assert (await day.instrument.connect()).startswith(NAME)
        await day.instrument.close()
        assert (await day.instrument.connect()).startswith(NAME)


async def test_readings_are_consecutive(kind: str) -> None:
    """No reading is repeated, and the timestamps are in the past."""
    async with bench(kind) as day:
        await day.instrument.connect()
        await day.instrument.track(2)
        readings = [await day.instrument.read() for _ in range(10)]
        now_ns = day.far.clock.monotonic_ns()
    stamps = [reading.at_ns for reading in readings]
    assert np.diff(stamps) == pytest.approx([PERIOD_NS] * 9, rel=0, abs=UNEVEN_NS)
    assert now_ns - PERIOD_NS < stamps[-1] <= now_ns
    assert {(reading.prism, reading.status.usable) for reading in readings} == {(2, True)}


async def test_cancelled_read_loses_no_reading(kind: str) -> None:
    """The next call returns it."""
    async with bench(kind) as day:
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
    assert np.diff(stamps) == pytest.approx([PERIOD_NS] * (len(stamps) - 1), rel=0, abs=UNEVEN_NS)


async def test_prism_change_drops_old_readings(kind: str) -> None:
    """All later readings are of the new prism."""
    async with bench(kind) as day:
        await day.instrument.connect()
        await day.instrument.track(1)
        await day.instrument.read()
        await asyncio.sleep(1.0)
        await day.instrument.track(3)
        day.far.station.aim_at_prism(3)
        assert [(await day.instrument.read()).prism for _ in range(3)] == [3, 3, 3]


async def test_single_measurements(kind: str) -> None:
    """In direct mode, of the target in the line of sight; NO_TARGET without one."""
    async with bench(kind) as day:
        await day.instrument.connect()
        await day.instrument.track(1)
        await day.instrument.direct()
        before_ns = day.far.clock.monotonic_ns()
        nothing = await day.instrument.measure()
        day.far.station.aim_at_target(1)
        measured = await day.instrument.measure()
    assert (nothing.prism, nothing.status, nothing.slope_distance_m) == (None, Status.NO_TARGET, None)
    assert (measured.prism, measured.status) == (None, Status.OK)
    assert measured.slope_distance_m == pytest.approx(20.6216, abs=0.01)
    assert measured.at_ns - before_ns > 2_000_000_000


async def test_calls_in_wrong_mode_raise(kind: str) -> None:
    """A single measurement while tracking, a reading while not; the instrument continues."""
    async with bench(kind) as day:
        await day.instrument.connect()
        await day.instrument.track(1)
        with pytest.raises(InstrumentError, match="call direct first"):
            await day.instrument.measure()
        await day.instrument.direct()
        with pytest.raises(InstrumentError, match="call track first"):
            await day.instrument.read()
        await day.instrument.track(1)
        async with asyncio.timeout(10.0):
            while (await day.instrument.read()).status is not Status.OK:
                pass  # it has to find the prism again


async def test_unplugged_cable_ends_read(kind: str) -> None:
    """After replugging it can be connected again."""
    async with bench(kind) as day:
        await day.instrument.connect()
        await day.instrument.track(1)
        await day.instrument.read()
        day.far.line.plugged = False
        with pytest.raises(InstrumentError, match="plug"):
            await day.instrument.read()
        with pytest.raises(InstrumentError):
            await day.instrument.connect()
        day.far.line.plugged = True
        await day.instrument.connect()
        await day.instrument.track(1)
        await day.instrument.read()
