"""How well the instrument's time is put on the host's clock, as measurements come.

    python benchmarks/run.py instrument_time

The first table is of the whole driver with a simulated instrument (20 ppm) and line, by the number of the distance since
it was connected. The second is of the clock fit only, without lines and drivers: instrument times in whole ms, a crystal that is off and wanders, answers
that are late by chance. Exchanges for the time alone are what is fitted: 12 at the beginning, one for each of the next 32
distances, then two a second, which is what a driver does without idle time. The error is that of the newest distance, with the exchanges before it.
What the fastest way itself needs is taken off, for the fit cannot see it. The figures stand in
docs/explanation/instrument-time.md.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.config import Baud, InstrumentModelConfig, LeicaInstrumentConfig, ScenarioConfig, SimulatedStation
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.world import scenario_world
from tsgt.station.leica import LeicaInstrument
from tsgt.timesync import InstrumentClock

if TYPE_CHECKING:
    from collections.abc import Callable

RUNS = 40
FASTEST_MS = 20.0
DURATION_S = 900.0

DRIVER_RUNS = 30
NUMBERS = ((1, 1), (2, 10), (11, 30), (31, 100), (101, 400))

PERIODS_S = ((0, 5), (5, 60), (60, 300), (300, 900))


class Case(NamedTuple):
    """What is tried."""

    name: str
    delay_ms: Callable[[np.random.Generator], float] = lambda random: random.uniform(0, 40)
    every_s: float = 0.5
    drift_ppm: float = 20.0
    wander_ppm: float = 0.0
    gap_s: tuple[float, float] = (0.0, 0.0)
    slows_s: tuple[float, float] = (0.0, 0.0)
    """Begin and end of a time in which responses become slower, four times in the end."""
    before: float = 0.0
    """Share of the delay that comes before the measurement."""
    timed: bool = True
    """Whether the durations of exchanges are known, as they are not behind a bridge."""
    no_fastest: bool = False
    """Whether the delay has no sharp lower end: then errors are against their own median."""


def _stalling(random: np.random.Generator) -> float:
    return random.uniform(300, 700) if random.random() < 0.1 else random.uniform(0, 40)


CASES = (
    Case("answers 0 to 40 ms late"),
    Case("0 to 10 ms late", delay_ms=lambda random: random.uniform(0, 10)),
    Case("0 to 40 ms, an exchange a second", every_s=1.0),
    Case("50 ppm", drift_ppm=50.0),
    Case("200 ppm", drift_ppm=200.0),
    Case("rate changes by 1 ppm a minute", wander_ppm=1.0),
    Case("exponentially late, 20 ms on average", delay_ms=lambda random: random.exponential(20)),
    Case("every tenth 300 to 700 ms late", delay_ms=_stalling),
    Case("normally late, sigma 6 ms", delay_ms=lambda random: abs(random.normal(30, 6)), no_fastest=True),
    Case("nothing from 30 s to 90 s", gap_s=(30.0, 90.0)),
    Case("slower from 30 s to 150 s, in the end four times", slows_s=(30.0, 150.0)),
    Case("the same, measured when it answers", slows_s=(30.0, 150.0), before=1.0),
    Case("the same, measured half-way", slows_s=(30.0, 150.0), before=0.5),
    Case("the same, without durations", slows_s=(30.0, 150.0), timed=False),
    Case("0 to 40 ms late, measured half-way", before=0.5),
    Case("0 to 40 ms late, without durations", timed=False),
)


def errors(case: Case, seed: int) -> list[tuple[float, float, float]]:
    """Return time since the start in s, error and bound in ms, of each stamp of one run."""
    random = np.random.default_rng(seed)
    drift = case.drift_ppm * random.choice((-1.0, 1.0)) * 1e-6
    instrument_at_zero_ms = random.uniform(1e5, 1e8)
    exchanges = np.r_[
        np.arange(12) * 0.05, 0.8 + np.arange(32) * 0.4, np.arange(13.8, DURATION_S, case.every_s)
    ]
    distances = 0.7 + np.arange(0, DURATION_S, 0.4) + random.normal(0, 0.004, round(DURATION_S / 0.4))
    wander = case.wander_ppm * 1e-6 / 60
    clock = InstrumentClock()
    found = []
    events = sorted([(true_s, False) for true_s in exchanges] + [(true_s, True) for true_s in distances])
    for true_s, is_distance in events:
        if case.gap_s[0] <= true_s < case.gap_s[1]:
            continue
        instrument_ms = math.floor(
            instrument_at_zero_ms + 1e3 * (true_s * (1 + drift) + 0.5 * wander * true_s**2)
        )
        delay_ms = FASTEST_MS + case.delay_ms(random)
        if case.slows_s[0] <= true_s < case.slows_s[1]:
            delay_ms *= 4.0 ** ((true_s - case.slows_s[0]) / (case.slows_s[1] - case.slows_s[0]))
        late_ms = (1 - case.before) * (delay_ms - FASTEST_MS)
        arrived_ns = round(1e9 * (1000 + true_s) + 1e6 * (FASTEST_MS + late_ms))
        if not is_distance:
            clock.add(instrument_ms, arrived_ns, round(1e6 * delay_ms) if case.timed else None)
            continue
        time = clock.timestamp(instrument_ms, arrived_ns + 40_000_000)
        if time is not None:
            error_ms = (time.host_ns - 1e9 * (1000 + true_s)) / 1e6 - FASTEST_MS
            found.append((float(true_s), error_ms, time.bound_ns / 1e6))
    return found


class Driven(NamedTuple):
    """An instrument and a line for the whole driver."""

    rate_hz: float
    processing_ms: tuple[float, float] = (20.0, 60.0)
    baud: Baud = 115_200


DRIVEN = (Driven(2.5), Driven(2.5, (5.0, 10.0)), Driven(2.5, baud=9600), Driven(7.0), Driven(20.0))


async def driven(case: Driven, seed: int, timeline: VirtualTimeline) -> list[float]:
    """Return the errors in ms of the first distances of one run."""
    fastest_ms, slowest_ms = case.processing_ms
    model = InstrumentModelConfig(processing_min_ms=fastest_ms, processing_max_ms=slowest_ms, baud=case.baud)
    station = SimulatedStation(
        station=1, prism=1, position_m=(0.0, 0.0, 0.0), rate_hz=case.rate_hz, instrument=model
    )
    scenario = ScenarioConfig(stations=(station,))
    last = NUMBERS[-1][1]
    world = scenario_world(scenario, last / case.rate_hz + 60, np.random.default_rng(1))
    clock = VirtualClock(0)
    far_end = SimulatedTotalStation(station, scenario, world, timeline, np.random.default_rng(seed))
    config = LeicaInstrumentConfig(
        kind="leica",
        port=Path("/dev/simulated"),
        baud=case.baud,
        prism_type="user",
        prism_constant_mm=0.0,
        latency_ms=fastest_ms,
    )
    driver = LeicaInstrument(config, SimulatedLine(far_end, timeline, clock).open, clock)
    await driver.connect()
    await driver.track(1)
    found: list[float] = []
    while len(found) < last:
        reading = await driver.read()
        if reading.slope_distance_m is not None:
            found.append((reading.at_ns - far_end.reported_distances[-1].true_ns) / 1e6)
    await driver.close()
    return found


def drivers() -> None:
    """Print a table of whole drivers."""
    numbers = " | ".join(f"{first} to {last}" if first != last else f"{first}" for first, last in NUMBERS)
    print(f"| distances per s, answers after, baud; error in ms: rms / largest | {numbers} |")
    print("|---" * (len(NUMBERS) + 1) + "|")
    for case in DRIVEN:
        runs = []
        for seed in range(DRIVER_RUNS):
            timeline = VirtualTimeline()

            async def run(
                case: Driven = case, seed: int = seed, timeline: VirtualTimeline = timeline
            ) -> list[float]:
                return await driven(case, seed, timeline)

            runs.append(run_virtual(run, timeline))
        table = np.array(runs)
        parts = [table[:, first - 1 : last] for first, last in NUMBERS]
        cells = " | ".join(f"{np.sqrt(np.mean(part**2)):.2f} / {np.abs(part).max():.1f}" for part in parts)
        fastest_ms, slowest_ms = case.processing_ms
        print(f"| {case.rate_hz:g}, {fastest_ms:g} to {slowest_ms:g} ms, {case.baud} | {cells} |", flush=True)
    print()


def main() -> None:
    """Print the tables."""
    drivers()
    periods = " | ".join(f"{begin} to {end} s" for begin, end in PERIODS_S)
    print(f"| error in ms: median / largest | {periods} | bound, median | outside it |")
    print("|---" * (len(PERIODS_S) + 3) + "|")
    for case in CASES:
        table = np.array([row for seed in range(RUNS) for row in errors(case, seed)])
        if case.no_fastest:
            table[:, 1] -= np.median(table[:, 1])
        cells = []
        for begin, end in PERIODS_S:
            part = np.abs(table[(table[:, 0] >= begin) & (table[:, 0] < end), 1])
            cells.append(f"{np.median(part):.2f} / {part.max():.1f}")
        outside = np.mean(np.abs(table[:, 1]) > table[:, 2])
        print(f"| {case.name} | {' | '.join(cells)} | {np.median(table[:, 2]):.1f} | {100 * outside:.3f} % |")
