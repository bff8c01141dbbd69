"""What goes wrong on the line, and codes from every family: no wrong value, no wrong time, no hang."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.leica import leica_bench, leica_config

from tsgt.errors import InstrumentError
from tsgt.simulation.instrument import LineFault
from tsgt.simulation.instrument.geocom import ForcedResponse
from tsgt.simulation.instrument.total_station import BOOT_NS
from tsgt.station.geocom import ReturnCode, Rpc

if TYPE_CHECKING:
    from harness.leica import LeicaBench

    from tsgt.station import Reading

# A digit that is another one takes a checksum to be seen: see simulation/serial_scripts.py.
FAULTS = [fault for fault in LineFault if fault not in (LineFault.NONE, LineFault.WRONG_DIGIT)]


async def keep(day: LeicaBench, seconds: float) -> list[Reading]:
    """Read, and connect again after each error, as the client does; return the readings."""
    readings: list[Reading] = []
    until_s = day.now_s + seconds
    connected = False
    while day.now_s < until_s:
        try:
            if not connected:
                await day.begin()
                connected = True
            async with asyncio.timeout(until_s - day.now_s):
                while True:
                    readings.append(await day.instrument.read())
        except TimeoutError:
            break
        except InstrumentError:
            connected = False
            await day.instrument.close()
            await asyncio.sleep(0.3)
    return readings


def check(day: LeicaBench, readings: list[Reading], *, latency_ms: float = 20.0) -> None:
    """Every distance was offered, is given once, and has its time."""
    offered = {offered.instrument_ms: offered for offered in day.station.reported_distances}
    usable = [reading for reading in readings if reading.status.usable]
    times = [reading.instrument_time_ns for reading in usable]
    assert len(times) == len(set(times))
    for reading in usable:
        assert reading.instrument_time_ns is not None
        source = offered[reading.instrument_time_ns // 1_000_000]
        assert reading.slope_distance_m == pytest.approx(source.distance_m, abs=1e-9)
        assert reading.horizontal_angle_rad == pytest.approx(source.horizontal_angle_rad, abs=1e-9)
        assert abs(reading.at_ns - source.true_ns - latency_ms * 1e6) < 25e6


@pytest.mark.parametrize("fault", FAULTS)
async def test_a_fault_costs_some_seconds_at_most(fault: LineFault) -> None:
    """One answer in ten goes wrong in this way: readings stay right, and most of them come."""
    async with leica_bench() as day:
        await day.begin()
        random = np.random.default_rng(5)
        for _ in range(20):
            day.line.faults.script.extend(
                fault if random.random() < 0.1 else LineFault.NONE for _ in range(30)
            )
        readings = await keep(day, 60.0)
        check(day, readings)
        day.line.faults.script.clear()
        after = await keep(day, 10.0)
    assert len([reading for reading in after if reading.status.usable]) >= 14


@pytest.mark.parametrize("seed", range(12))
async def test_scripts_of_faults(seed: int) -> None:
    """Several of them at once, with checksums or without."""
    random = np.random.default_rng(seed)
    async with leica_bench(leica_config(checksum=bool(seed % 2)), seed=seed) as day:
        for _ in range(600):
            fault = FAULTS[random.integers(len(FAULTS))] if random.random() < 0.05 else LineFault.NONE
            day.line.faults.script.append(fault)
        readings = await keep(day, 60.0)
    check(day, readings)
    assert len(readings) > 40


@pytest.mark.parametrize("code", sorted(set(ReturnCode)))
async def test_any_code_is_survived(code: ReturnCode) -> None:
    """Whatever a measurement and the lock are answered with, for a while: it goes on when the answers do."""
    async with leica_bench() as day:
        await day.begin()
        readings = await keep(day, 3.0)
        com = 3072 <= code < 3328
        for rpc in (Rpc.TMC_GET_FULL_MEAS, Rpc.MOT_READ_LOCK_STATUS):
            forced = (
                ForcedResponse(com_code=code, rpc=rpc, times=8)
                if com
                else ForcedResponse(code=code, rpc=rpc, times=8)
            )
            day.station.server.forced.append(forced)
        readings += await keep(day, 30.0)
        check(day, readings)
        after = await keep(day, 20.0)
    assert len([reading for reading in after if reading.status.usable]) >= 20


async def test_a_silent_line_raises() -> None:
    """Nothing comes any more: an error within some seconds, and another one for each attempt to connect."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(5.0)
        day.line.faults.drop_responses = True
        begun_s = day.now_s
        with pytest.raises(InstrumentError):
            await day.read_for(30.0)
        assert day.now_s - begun_s < 12.0
        await day.instrument.close()
        with pytest.raises(InstrumentError):
            await day.instrument.connect()
        day.line.faults.drop_responses = False
        await day.begin()
        assert (await day.instrument.read()).status.usable


async def test_a_search_that_was_switched_off_is_not_waited_for() -> None:
    """Its answer never comes. The driver notices within 4 s of the instrument being there again, not after the search's 90."""
    async with leica_bench() as day:
        await day.begin()
        day.station.blocked = True
        while "searching" not in day.instrument.condition.activity:
            await day.instrument.read()
        await day.read_for(0.7)
        day.station.switch_off()
        day.station.switch_on()
        with pytest.raises(InstrumentError, match="switched off and on"):
            await day.read_for(BOOT_NS / 1e9 + 4.1)


async def test_another_speed_is_found() -> None:
    """The instrument has been set to 19200 by somebody."""
    async with leica_bench() as day:
        day.station.baud = 19_200
        await day.begin()
        assert len(await day.read_for(20.0)) >= 45
