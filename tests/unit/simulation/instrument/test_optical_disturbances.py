"""Disturbances of the line of sight: shimmer by range and hour, rain by range and rate, multipath, prisms of others."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest
from harness.instruments.total_stations import SETUP, SILENT, STANDING, Bench, with_station

from tsgt.config import ScenarioConfig
from tsgt.simulation.instrument.edm import EdmSchedule
from tsgt.simulation.instrument.optical_disturbances import (
    RAIN_SIGMA_M,
    HeatShimmer,
    Multipath,
    PolarPoint,
    Rain,
    structure_parameter,
)


def _prism(distance_m: float) -> PolarPoint:
    return PolarPoint(1.0, math.radians(80.0), distance_m)


def _shimmered(hour: float, distance_m: float, *, step_s: float = 10.0) -> np.ndarray:
    """Return errors of a prism along and across the line of sight in m, (N, 3)."""
    air = HeatShimmer(1e-12, hour, 0.3, np.random.default_rng(1))
    true = _prism(distance_m)
    seen = np.array([air.apply(true, number * step_s) for number in range(360)])
    errors: np.ndarray = (seen - np.array(true)) * [
        distance_m * math.sin(true.zenith_rad),
        distance_m,
        1.0,
    ]
    return errors


def test_shimmer_follows_the_sun() -> None:
    """Strongest at noon, none in the early morning and in the evening."""
    at = [structure_parameter(1e-12, hour) for hour in (6.0, 9.0, 13.0, 17.0, 20.0)]
    assert at[0] == at[4] == 0.0
    assert at[1] == pytest.approx(at[3])
    assert at[1] < at[2] == 1e-12


@pytest.mark.parametrize("distance_m", [50.0, 200.0])
def test_shimmer_grows_with_the_range(distance_m: float) -> None:
    """Angles by its square root: 13 and 25 microradians in strong turbulence; distances have less noise."""
    sigma_rad = HeatShimmer(1e-12, 12.5, 0.3, np.random.default_rng(1)).angle_sigma_rad(distance_m, 1800.0)
    assert sigma_rad == pytest.approx(12.6e-6 * math.sqrt(distance_m / 50.0), rel=0.01)
    errors = _shimmered(12.5, distance_m).std(axis=0)
    assert errors[:2] == pytest.approx(np.full(2, sigma_rad * distance_m), rel=0.15)
    assert errors[2] < errors[0]


def test_shimmer_is_correlated_over_tenths_of_seconds() -> None:
    """Errors 0.1 s apart are alike, those 10 s apart are not."""
    for step_s, expected in ((0.1, math.exp(-1 / 3)), (10.0, 0.0)):
        errors = _shimmered(13.0, 100.0, step_s=step_s)[:, 0]
        assert np.corrcoef(errors[1:], errors[:-1])[0, 1] == pytest.approx(expected, abs=0.12)


def test_rain_misses_distances_and_adds_noise() -> None:
    """A quarter at short range in the heaviest rain, hardly any in drizzle."""
    true = _prism(75.0)
    for rate_mmph, missed, sigma_m in ((50.0, 0.25, RAIN_SIGMA_M), (2.0, 0.01, 0.04 * RAIN_SIGMA_M)):
        rain = Rain(rate_mmph, np.random.default_rng(2))
        seen = [rain.apply(true, 0.0) for _ in range(2000)]
        distances_m = [each.distance_m for each in seen if each is not None]
        assert 1 - len(distances_m) / 2000 == pytest.approx(missed, abs=0.02)
        assert np.std(distances_m) == pytest.approx(sigma_m, rel=0.1)


def test_rain_shortens_the_range() -> None:
    """A kilometre in clear air, about 300 m in the heaviest rain."""
    assert Rain(1e-9, np.random.default_rng(2)).margin_db(1000.0) == pytest.approx(0.0, abs=0.1)
    heavy = Rain(50.0, np.random.default_rng(2))
    assert heavy.margin_db(280.0) > 0 > heavy.margin_db(320.0)


async def test_disturbed_instrument_reports_what_the_disturbance_leaves() -> None:
    """A distance that is too long, or angles without a distance; right again without the disturbance."""
    bench = Bench(with_station(noise=SILENT))
    await bench.do(*SETUP)
    clear = (await bench.ask(2167, 1000, 1)).values
    bench.instrument.disturbances.append(Multipath(0.5))
    await bench.ask(2167, 1000, 1)
    for _ in range(10):
        late = (await bench.ask(2167, 1000, 1)).values
    assert float(late[6]) - float(clear[6]) == pytest.approx(0.5, abs=1e-6)
    assert late[:2] == clear[:2]

    class Opaque:
        def apply(self, measured: PolarPoint, at_s: float) -> None:
            """Let nothing return."""

    bench.instrument.disturbances.append(Opaque())
    replies = [await bench.ask(2167, 100, 1) for _ in range(20)]
    assert replies[-1].code == 1285
    assert float(replies[-1].values[6]) == 0.0
    bench.instrument.disturbances.clear()
    replies = [await bench.ask(2167, 1000, 1) for _ in range(20)]
    assert replies[-1].values[6] == clear[6]


def _other(bench: Bench, *, ahead_m: float, from_s: float, to_s: float) -> int:
    """Add a prism of somebody else's in line with that of station 1, farther away by this."""
    own = bench.world.prism_at(np.array([0.0]), 0)[0]
    place = own * (1 + ahead_m / np.linalg.norm(own))
    return bench.instrument.add_prism(lambda times_s: np.tile(place, (len(times_s), 1)), from_s, to_s, 1)


async def test_another_robots_prism_takes_the_lock_and_keeps_it() -> None:
    """Until it is out of sight; then the instrument finds its own prism, which is still in the field of view."""
    bench = Bench(with_station(noise=SILENT))
    await asyncio.sleep(0.75)
    other = _other(bench, ahead_m=5.0, from_s=0.75, to_s=20.0)
    assert bench.instrument.take_over(other)
    await bench.do(*SETUP)
    while bench.timeline.now_ns() < 40e9:
        await bench.ask(2167, 1000, 1)
    reported = bench.instrument.reported_distances
    far = [each for each in reported if each.true_ns < 19e9]
    near = [each for each in reported if each.true_ns > 23e9]
    assert {each.prism for each in far} == {other}
    assert {each.prism for each in near} == {1}
    assert far[-1].distance_m - near[-1].distance_m == pytest.approx(5.0, abs=0.01)


async def test_prism_outside_the_field_of_view_does_not_take_the_lock() -> None:
    """Nor one of another number when searching, if the prisms are active ones."""
    bench = Bench(ScenarioConfig(motion=STANDING))
    far = bench.instrument.add_prism(
        lambda times_s: np.tile([60.0, -45.0, 0.0], (len(times_s), 1)), 0.0, 99.0, 2
    )
    assert not bench.instrument.take_over(far)
    await bench.do((9027, math.atan2(45.0, 60.0), math.pi / 2, 0, 0, 0))
    assert await bench.code(9037, 0.1, 0.1, 0) == 8710


def test_slower_measurements_continue_the_series() -> None:
    """No instant is repeated or skipped when the interval changes; the usual one returns."""
    edm = EdmSchedule(100_000_000, 1e6, 0, np.random.default_rng(0))
    edm.start(0)
    ticks_ns: list[int] = []
    now_ns = 0
    for until_ns, factor in ((10**9, 1.0), (5 * 10**9, 4.0), (6 * 10**9, 1.0)):
        edm.slow_down(factor, now_ns)
        while (now_ns := edm.next_after(now_ns) or 0) < until_ns:
            assert edm.newest(now_ns) == now_ns
            ticks_ns.append(now_ns)
    steps_ms = np.diff(ticks_ns) / 1e6
    assert np.all(steps_ms > 90)
    assert steps_ms[:5] == pytest.approx(np.full(5, 100.0), abs=8)
    assert steps_ms[12:17] == pytest.approx(np.full(5, 400.0), abs=8)
    assert steps_ms[-5:] == pytest.approx(np.full(5, 100.0), abs=8)


async def test_slow_instrument_responds_later() -> None:
    """Four times the processing time, four times the interval."""
    bench = Bench(with_station(instrument={"processing_min_ms": 20.0, "processing_max_ms": 20.0}))
    took_ms = []
    for factor in (1.0, 4.0):
        bench.instrument.slow_down(factor)
        start_ns = bench.timeline.now_ns()
        await bench.ask(0)
        took_ms.append((bench.timeline.now_ns() - start_ns) / 1e6)
    assert took_ms[1] - took_ms[0] == pytest.approx(60.0, abs=1.0)
