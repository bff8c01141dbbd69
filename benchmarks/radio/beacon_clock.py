"""What a station makes of the beacons' times: errors and bounds in all scenarios, and what the fit costs.

Errors are those of the times as they go over the air, in steps of 16 us; see docs/explanation/superframe-clock.md.
``--json`` prints the same figures in us. ``--early-delays``: some of a session's first beacons share a delay.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import statistics
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from harness.clocks.beacon_scenarios import BEACON_SCENARIOS, run_beacon_scenario
from measuring import best_s

from tsgt.radio.superframe import SESSION_INTERVAL
from tsgt.radio.superframe.master import SESSION_INTERVAL_JOINING
from tsgt.radio.superframe.station_state import FULL_TIME_FRAMES
from tsgt.timesync import BeaconClock

if TYPE_CHECKING:
    from harness.clocks.beacon_scenarios import BeaconScenario, ReportedTime

EARLY = 12
"""Some of so many first beacons share a delay, drawn between these two."""
EARLY_DELAYS_US = (1000.0, 6500.0)
EARLY_RUNS = 200

SETTLED_S = 5.0
"""Live figures are of what is measured after this."""
FULL = 200
FRAME_NS = 400_000_000


@dataclass(frozen=True)
class Row:
    """Figures of a scenario, in us where nothing else is said."""

    scenario: str
    summary: str
    live_p50: float
    live_p99: float
    late_p50: float | None
    late_p99: float | None
    bound_p50: float
    bound_p99: float
    times: int
    broken: int
    nearest_to_bound: float


def main() -> None:
    """Print a row for each scenario, and what calls cost."""
    parser = argparse.ArgumentParser(description="Time errors of the fit of beacons, over many seeds.")
    parser.add_argument("--json", action="store_true", help="figures for a machine")
    parser.add_argument("--seeds", type=int, default=50, help="how many runs of each scenario (default 50)")
    parser.add_argument("--early-delays", action="store_true", help="only delays among the first beacons")
    arguments = parser.parse_args()
    if arguments.early_delays:
        early_delays()
        return
    rows = [row(scenario, arguments.seeds) for scenario in BEACON_SCENARIOS]
    if arguments.json:
        print(json.dumps({"rows": [asdict(r) for r in rows], "cost_us": cost_us()}, indent=1))
        return
    print(
        "| scenario | what happens | live p50 | p99 | late p50 | p99 | bound p50 | p99 | times | outside | error/bound |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for r in rows:
        late = "| | " if r.late_p50 is None else f"| {r.late_p50:.0f} | {r.late_p99:.0f} "
        print(
            f"| `{r.scenario}` | {r.summary} | {r.live_p50:.0f} | {r.live_p99:.0f} {late}"
            f"| {r.bound_p50:.0f} | {r.bound_p99:.0f} | {r.times} | {r.broken} | {r.nearest_to_bound:.2f} |"
        )
    print()
    for call, figure in cost_us().items():
        print(f"{call}: {figure:.0f} us")


def early_delays() -> None:
    """Print a row for each number of delayed beacons."""
    print("| delayed | runs | outside | furthest outside, us | bound after 16 s, p50, us |")
    print("|---|---|---|---|---|")
    for count in range(6):
        found = [early_delay(count, seed) for seed in range(EARLY_RUNS)]
        beyond_us, bounds_us = np.array(found).T
        largest_us = max(float(beyond_us.max()), 0.0)
        outside = np.count_nonzero(beyond_us > 0)
        print(
            f"| {count} | {EARLY_RUNS} | {outside} | {largest_us:.0f} | {np.median(bounds_us):.0f} |",
            flush=True,
        )


def early_delay(count: int, seed: int) -> tuple[float, float]:
    """Run 16 s of a session; return by how much a time exceeded its bound, and the last bound, in us."""
    rng = np.random.default_rng([count, seed])
    jitter_us, skew = float(rng.choice([3.0, 20.0])), 1 + float(rng.uniform(-50, 50)) / 1e6
    late_us = np.zeros(40)
    late_us[rng.choice(EARLY, count, replace=False)] = rng.uniform(*EARLY_DELAYS_US)
    clock, beyond_us, bound_us = BeaconClock(), -math.inf, math.nan
    for frame, delay_us in enumerate(late_us.tolist()):
        true_us = 7000 + FRAME_NS // 1000 * frame
        received_ns = 10**12 + round(1000 * (skew * true_us + delay_us + rng.normal(0.0, jitter_us)))
        sent_us = round(true_us + rng.normal(0.0, jitter_us))
        every = SESSION_INTERVAL if clock.initialised else SESSION_INTERVAL_JOINING
        unambiguous = frame < FULL_TIME_FRAMES or frame % every == 0
        sigma_ns = round(1000 * jitter_us)
        full_us = sent_us if unambiguous else clock.unwrap(received_ns, sent_us & 0xFFFF, sigma_ns)
        if full_us is not None:
            clock.add(received_ns, full_us, sigma_ns, unambiguous=unambiguous)
        for before_s in (-0.2, 0.3, 1.0, 2.0, 4.0, 8.0, 20.0) if clock.converged else ():
            asked_us = true_us - 1e6 * before_s
            found = clock.at(10**12 + round(1000 * skew * asked_us))
            assert found is not None  # noqa: S101 (converged)
            bound_us = found.bound_us if before_s < 0 else bound_us
            beyond_us = max(beyond_us, abs(found.time_us - asked_us) - found.bound_us)
    return beyond_us, bound_us


def row(scenario: BeaconScenario, seeds: int) -> Row:
    """Run a scenario with seeds 0 and up."""
    times = [t for seed in range(seeds) for t in run_beacon_scenario(scenario, seed).times]
    live = [t for t in times if t.live and t.measured_s >= SETTLED_S]
    late = [t for t in times if not t.live and t.measured_s >= SETTLED_S]
    ratios = [abs(t.error_us) / t.bound_us for t in times]
    bounds = np.quantile([t.bound_us for t in live], [0.5, 0.99])
    return Row(
        scenario=scenario.name,
        summary=scenario.summary,
        live_p50=_error(live, 0.5),
        live_p99=_error(live, 0.99),
        late_p50=_error(late, 0.5) if late else None,
        late_p99=_error(late, 0.99) if late else None,
        bound_p50=float(bounds[0]),
        bound_p99=float(bounds[1]),
        times=len(times),
        broken=sum(ratio > 1 for ratio in ratios),
        nearest_to_bound=max(ratios),
    )


def _error(times: list[ReportedTime], share: float) -> float:
    return float(np.quantile([abs(t.rounded_us) for t in times], share))


def cost_us() -> dict[str, float]:
    """Time calls of a clock with 200 pairs and more: medians."""
    jitter_ns = np.random.default_rng(0).normal(0.0, 28_000, 2 * FULL)
    pairs = [(10**12 + k * FRAME_NS + round(jitter_ns[k]), k * FRAME_NS // 1000) for k in range(2 * FULL)]
    clock = BeaconClock()
    for received_ns, sent_us in pairs[:FULL]:
        clock.add(received_ns, sent_us, 20_000)
    adding, live = [], []
    for received_ns, sent_us in pairs[FULL:]:
        adding.append(best_s(partial(clock.add, received_ns, sent_us, 20_000), 1))
        live.append(best_s(partial(clock.at, received_ns - FRAME_NS // 2), 1))
    firsts = [best_s(partial(copy.deepcopy(clock).at, pairs[FULL][0]), 1) for _ in range(5)]
    past = [best_s(partial(clock.at, received_ns + 1), 1) for received_ns, _ in reversed(pairs[:FULL])]
    return {
        "add": 1e6 * statistics.median(adding),
        "at, live": 1e6 * statistics.median(live),
        "at, one after the other of an outage": 1e6 * statistics.median(past),
        "at, the first of them": 1e6 * statistics.median(firsts),
    }
