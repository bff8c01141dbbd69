"""Ten troubles of a station's clock: time error of the paper's filter and of the regression, against the truth.

Each scenario is four hours of exchanges and measurements at the protocol's schedule; see
docs/explanation/clock-offset.md. ``--json`` prints the same figures in nanoseconds.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import TYPE_CHECKING

from harness.clocks.clock_scenarios import SCENARIOS, run_clock_scenario
from measuring import Stopwatch

if TYPE_CHECKING:
    from harness.clocks.clock_scenarios import ClockOutcome


def main() -> None:
    """Print a row for each scenario and filter."""
    parser = argparse.ArgumentParser(description="Time errors of both clock filters in ten scenarios.")
    parser.add_argument("--json", action="store_true", help="figures in ns, for a machine")
    parser.add_argument("--seed", type=int, default=0, help="of the exchanges (default 0)")
    arguments = parser.parse_args()
    with Stopwatch() as stopwatch:
        outcomes = [
            run_clock_scenario(scenario, name, seed=arguments.seed)
            for scenario in SCENARIOS
            for name in ("paper", "regression")
        ]
    if arguments.json:
        print(json.dumps([asdict(outcome) for outcome in outcomes], indent=1))
        return
    print("absolute time error in ms; held: share of stamps within the stated bound, bound: its median in ms")
    print("| scenario | filter | p50 | p99 | max | held | bound |")
    print("|---|---|---|---|---|---|---|")
    for outcome in outcomes:
        print(_row(outcome))
    print(f"{len(outcomes)} runs, {stopwatch.cpu_s:.1f} s of CPU")


def _row(outcome: ClockOutcome) -> str:
    figures = (outcome.p50_ns, outcome.p99_ns, outcome.max_ns)
    errors = " | ".join(f"{figure / 1e6:.3f}" for figure in figures)
    held = f"{outcome.bound_held:.2%} | {outcome.bound_p50_ns / 1e6:.1f}"
    return f"| {outcome.scenario} | {outcome.filter} | {errors} | {held} |"
