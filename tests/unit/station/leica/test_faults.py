"""Faults of the line, and return codes of every family: no wrong value, no wrong time, no hang."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.instruments.leica import leica_bench, leica_config

from tsgt.errors import InstrumentError
from tsgt.simulation.instrument import LineFault
from tsgt.simulation.instrument.geocom import ForcedResponse
from tsgt.simulation.instrument.total_station import BOOT_NS
from tsgt.station.geocom import ReturnCode, Rpc

if TYPE_CHECKING:
    from harness.instruments.leica import LeicaBench

    from tsgt.station import Reading

# A changed digit is detected by a checksum only: see harness/instruments/serial_scripts.py.
FAULTS = [fault for fault in LineFault if fault not in (LineFault.NONE, LineFault.WRONG_DIGIT)]


async def read_through_errors(day: LeicaBench, seconds: float) -> list[Reading]:
    """Read, and reconnect after each error, as the client does."""
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
    """Check that every distance was offered, is reported once, and has its time."""
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
async def test_line_fault_costs_few_readings(fault: LineFault) -> None:
    """One reply in ten is affected: readings stay correct, and most of them arrive."""
    async with leica_bench() as day:
        await day.begin()
        random = np.random.default_rng(5)
        for _ in range(20):
            day.line.faults.script.extend(
                fault if random.random() < 0.1 else LineFault.NONE for _ in range(30)
            )
        readings = await read_through_errors(day, 60.0)
        check(day, readings)
        day.line.faults.script.clear()
        after = await read_through_errors(day, 10.0)
    assert len([reading for reading in after if reading.status.usable]) >= 14


@pytest.mark.parametrize("seed", range(12))
async def test_mixed_line_faults_give_no_wrong_reading(seed: int) -> None:
    """Several of them at once, with checksums or without."""
    random = np.random.default_rng(seed)
    async with leica_bench(leica_config(checksum=bool(seed % 2)), seed=seed) as day:
        for _ in range(600):
            fault = FAULTS[random.integers(len(FAULTS))] if random.random() < 0.05 else LineFault.NONE
            day.line.faults.script.append(fault)
        readings = await read_through_errors(day, 60.0)
    check(day, readings)
    assert len(readings) > 40


@pytest.mark.parametrize("code", sorted(set(ReturnCode)))
@pytest.mark.slow
async def test_any_return_code_is_survived(code: ReturnCode) -> None:
    """Measurements and lock queries return it for a while; tracking continues afterwards."""
    async with leica_bench() as day:
        await day.begin()
        readings = await read_through_errors(day, 3.0)
        com = 3072 <= code < 3328
        for rpc in (Rpc.TMC_GET_FULL_MEAS, Rpc.MOT_READ_LOCK_STATUS):
            forced = (
                ForcedResponse(com_code=code, rpc=rpc, times=8)
                if com
                else ForcedResponse(code=code, rpc=rpc, times=8)
            )
            day.station.server.forced.append(forced)
        readings += await read_through_errors(day, 30.0)
        check(day, readings)
        after = await read_through_errors(day, 20.0)
    assert len([reading for reading in after if reading.status.usable]) >= 20


async def test_silent_line_raises() -> None:
    """An error within some seconds, and for each attempt to connect."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(5.0)
        day.line.faults.drop_responses = True
        start_s = day.now_s
        with pytest.raises(InstrumentError):
            await day.read_for(30.0)
        assert day.now_s - start_s < 12.0
        await day.instrument.close()
        with pytest.raises(InstrumentError):
            await day.instrument.connect()
        day.line.faults.drop_responses = False
        await day.begin()
        assert (await day.instrument.read()).status.usable


async def test_power_cycle_during_search_is_detected() -> None:
    """The search's reply never comes: an error within 4 s of the instrument's return, not after the search's timeout of 90 s."""
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


async def test_other_baud_rate_is_found() -> None:
    """The instrument has been set to 19200."""
    async with leica_bench() as day:
        day.station.baud = 19_200
        await day.begin()
        assert len(await day.read_for(20.0)) >= 45
