"""The client daemon with a Leica on a serial line: every offered distance is journalled, whatever happens."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from harness.hardware.radios import PAPER
from harness.instruments.leica import LeicaBench, leica_bench
from harness.radio.client import client_config
from structlog.testing import capture_logs
from unit.station.test_control_socket import WARM, journalled, no_radio, talk

from tsgt.recording.journal import load_journal
from tsgt.station import ClientDependencies, run_client

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

    from tsgt.model import PolarMeasurement


@asynccontextmanager
async def client(folder: Path, *, rate_hz: float = 2.5, seed: int = 2) -> AsyncGenerator[LeicaBench]:
    """Run a client with a simulated Leica and without a radio."""
    async with leica_bench(rate_hz=rate_hz, seed=seed) as bench:
        running = asyncio.create_task(
            run_client(
                client_config(folder),
                PAPER,
                ClientDependencies(instrument=bench.instrument, open_radio=no_radio, clock=bench.clock),
            )
        )
        try:
            yield bench
        finally:
            running.cancel()
            await asyncio.wait([running])


def measurements(folder: Path) -> list[PolarMeasurement]:
    """Return the measurements of the only journal."""
    (path,) = (folder / "journals").iterdir()
    return load_journal(path).measurements


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [2.5, 20.0])
async def test_offered_distance_is_journalled_once(tmp_path: Path, rate_hz: float) -> None:
    """With the instrument's time, the arrival of the reply, and a timestamp between measurement and arrival."""
    async with client(tmp_path, rate_hz=rate_hz) as bench:
        await asyncio.sleep(60.0)
        true_ns = {1_000_000 * each.instrument_ms: each.true_ns for each in bench.station.reported_distances}
    journal = [each for each in measurements(tmp_path) if each.slope_distance_m is not None]
    times = [each.instrument_time_ns for each in journal]
    assert len(set(times)) == len(times) >= rate_hz * 45
    assert set(times) <= set(true_ns)
    assert len(true_ns) - len(times) <= 1  # that was on its way at the end
    (head,) = journalled(tmp_path, "journal")
    for each in journal:
        assert each.instrument_time_ns is not None
        late_ns = each.stamp_ns - head["unix_at_zero_ns"] - true_ns[each.instrument_time_ns]
        assert 0 < late_ns < 60_000_000  # the part of the latency that is the same each time
        assert each.stamp_ns < each.received_ns


@pytest.mark.parametrize("seed", range(5))
async def test_replugged_cable_brings_measurements_within_three_seconds(tmp_path: Path, seed: int) -> None:
    """However long it was out, and whatever the client was doing; logged once."""
    async with client(tmp_path, seed=seed) as bench:
        await asyncio.sleep(10.0)
        with capture_logs() as logs:
            for away_s in (0.3, 7.0, 61.0):
                bench.line.plugged = False
                await asyncio.sleep(away_s + 0.173 * seed)
                bench.line.plugged = True
                before = len(measurements(tmp_path))
                await asyncio.sleep(3.0)
                new = measurements(tmp_path)[before:]
                assert any(each.status.usable for each in new)
                await asyncio.sleep(10.0)
    assert [entry["event"] for entry in logs].count("instrument_lost") <= 2 * 3


async def test_power_cycled_instrument_recovers(tmp_path: Path) -> None:
    """Its clock restarts and the operator locks on again; timestamps continue."""
    async with client(tmp_path) as bench:
        await asyncio.sleep(10.0)
        bench.station.switch_off()
        await asyncio.sleep(20.0)
        (status,) = await talk(tmp_path)
        assert status["instrument"] is None
        assert status["problem"]
        bench.station.switch_on()
        await asyncio.sleep(6.0)
        bench.station.lock_manually(1)
        await asyncio.sleep(20.0)
    usable = [each for each in measurements(tmp_path) if each.status.usable]
    stamps = [each.stamp_ns for each in usable]
    assert stamps == sorted(stamps)
    assert stamps[-1] - stamps[0] > 50_000_000_000
    assert usable[-1].instrument_time_ns is not None
    assert usable[-1].instrument_time_ns < 30_000_000_000


async def test_atmosphere_survives_reconnection(tmp_path: Path) -> None:
    """The journalled settings are the instrument's settings."""
    async with client(tmp_path) as bench:
        await asyncio.sleep(5.0)
        _, response = await talk(tmp_path, WARM + b"\n")
        assert (response["problem"], response["settings"]["temperature_c"]) == ("", 25.0)
        assert response["settings"]["atmospheric_ppm"] == pytest.approx(16.0, abs=1.0)
        bench.line.plugged = False
        await asyncio.sleep(1.0)
        bench.line.plugged = True
        await asyncio.sleep(5.0)
        (status,) = await talk(tmp_path)
    assert status["settings"]["temperature_c"] == 25.0
    assert journalled(tmp_path, "instrument")[-1]["temperature_c"] == 25.0
