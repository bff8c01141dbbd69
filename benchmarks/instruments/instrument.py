"""How fast the driver for Leica instruments reads a simulated one, and what that costs.

    python benchmarks/run.py instrument

Ten minutes of virtual time for each row, over a line that has the pace of a real one. Ticks are the instants at which the
instrument takes a distance; "offered" are those that an answer has carried. CPU is that of driver, line and simulated
instrument together, per minute of measuring.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsgt.config import InstrumentModelConfig, LeicaInstrumentConfig, ScenarioConfig, SimulatedStation
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.world import scenario_world
from tsgt.station.leica import LeicaInstrument

DURATION_S = 600.0


class Case(NamedTuple):
    """An instrument and a line."""

    rate_hz: float
    processing_ms: tuple[float, float] = (20.0, 60.0)
    baud: int = 115_200


CASES = (
    Case(2.5),
    Case(7.0),
    Case(10.0, (5.0, 10.0)),
    Case(20.0, (5.0, 10.0)),
    Case(20.0),
    Case(22.8),
    Case(2.5, baud=19_200),
    Case(2.5, baud=9600),
    Case(20.0, (5.0, 10.0), 19_200),
)


class Result(NamedTuple):
    """What came of a case."""

    ticks: float
    offered: int
    read: int
    repeated: int
    age_ms: tuple[float, float]
    cpu_s: float


async def run(case: Case, timeline: VirtualTimeline) -> Result:
    """Measure for ten minutes."""
    model = InstrumentModelConfig(
        processing_min_ms=case.processing_ms[0], processing_max_ms=case.processing_ms[1], baud=case.baud
    )
    station = SimulatedStation(
        station=1, prism=1, position_m=(0.0, 0.0, 0.0), rate_hz=case.rate_hz, instrument=model
    )
    scenario = ScenarioConfig(stations=(station,))
    world = scenario_world(scenario, DURATION_S + 20, np.random.default_rng(1))
    clock = VirtualClock(0)
    far_end = SimulatedTotalStation(station, scenario, world, timeline, np.random.default_rng(2))
    config = LeicaInstrumentConfig(
        kind="leica", port=Path("/dev/simulated"), baud=115_200, prism_type="user", prism_constant_mm=0.0
    )
    config = config.model_copy(update={"baud": case.baud})
    driver = LeicaInstrument(config, SimulatedLine(far_end, timeline, clock).open, clock)
    await driver.connect()
    await driver.track(1)
    await driver.read()
    begun_ns, begun_cpu_s, before = clock.monotonic_ns(), time.process_time(), len(far_end.reported_distances)
    readings, ages_ms = [], []
    while clock.monotonic_ns() < begun_ns + DURATION_S * 1e9:
        reading = await driver.read()
        readings.append(reading.instrument_time_ns)
        ages_ms.append((clock.monotonic_ns() - far_end.reported_distances[-1].true_ns) / 1e6)
    cpu_s = time.process_time() - begun_cpu_s
    offered = len(far_end.reported_distances) - before
    await driver.close()
    return Result(
        ticks=DURATION_S * case.rate_hz,
        offered=offered,
        read=len(set(readings)),
        repeated=len(readings) - len(set(readings)),
        age_ms=(float(np.median(ages_ms)), float(np.percentile(ages_ms, 99))),
        cpu_s=cpu_s,
    )


def main() -> None:
    """Print a table."""
    print(
        "| ticks per s | answers after | baud | read per s | of all ticks | of those offered | twice | age, p50 / p99 | CPU per min |"
    )
    print("|---" * 9 + "|")
    for case in CASES:
        timeline = VirtualTimeline()

        async def measured(case: Case = case, timeline: VirtualTimeline = timeline) -> Result:
            return await run(case, timeline)

        result = run_virtual(measured, timeline)
        print(
            f"| {case.rate_hz:g} | {case.processing_ms[0]:g} to {case.processing_ms[1]:g} ms | {case.baud}"
            f" | {result.read / DURATION_S:.2f} | {100 * result.read / result.ticks:.1f} %"
            f" | {100 * result.read / result.offered:.2f} % | {result.repeated}"
            f" | {result.age_ms[0]:.0f} / {result.age_ms[1]:.0f} ms | {result.cpu_s / DURATION_S * 60:.3f} s |"
        )
