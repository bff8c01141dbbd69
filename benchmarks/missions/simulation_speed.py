"""A whole mission on virtual time: simulated seconds per second of CPU, split in simulation, checkers and replay.

The scenario ``dynamic`` with each protocol and each estimator: the real daemons, chips at register level, instruments
that speak GeoCOM, and afterwards every checker. CPU time is that of the whole process, the least of the runs; on a
machine that is busy with other things it grows, so compare figures of one sitting only. The replay reads the recording,
computes all poses again as the master did, and compares each line; the soak test checks it in a quarter of the missions.
Its CPU time is that of live estimation. The five seconds of the drain
at the end of a run are simulated and not counted.

Run ``python benchmarks/run.py simulation_speed [SECONDS] [RUNS]``.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING

from measuring import Stopwatch, simulated

from tsgt.config import ClassicMasterConfig, SuperframeMasterConfig
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.checks.invariants import replay_mismatches
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from tsgt.config import ScenarioConfig

DURATION_S = 120.0
RUNS = 2
SEED = 3
PROTOCOLS = (ClassicMasterConfig(kind="classic"), SuperframeMasterConfig(kind="superframe"))
ESTIMATORS = ("linear", "continuous")


def main() -> None:
    """Print a row for each protocol and estimator."""
    duration_s = float(sys.argv[1]) if len(sys.argv) > 1 else DURATION_S
    runs = int(sys.argv[2]) if len(sys.argv) > 2 else RUNS
    scenario = find_scenario("dynamic")
    print(f"dynamic, {duration_s:g} simulated seconds, seed {SEED}; CPU time is the least of {runs} runs")
    print(
        f"{'':24}{'simulation CPU s':>18}{'checkers CPU s':>16}{'simulated s per CPU s':>23}"
        f"{'with replay':>13}{'replay CPU ms per s':>21}"
    )
    for protocol in PROTOCOLS:
        for estimator in ESTIMATORS:
            settings = scenario.pipeline.model_copy(update={"estimator": estimator})
            chosen = scenario.model_copy(update={"pipeline": settings})
            options = SimulationOptions(duration_s=duration_s, protocol=protocol, seed=SEED)
            simulation_s, checkers_s, replay_s = min((timed(chosen, options) for _ in range(runs)), key=sum)
            once_s = simulation_s + checkers_s
            print(
                f"{f'{protocol.kind}, {estimator}':24}{simulation_s:18.2f}{checkers_s:16.2f}"
                f"{duration_s / once_s:23.1f}{duration_s / (once_s + replay_s):13.1f}"
                f"{1e3 * replay_s / duration_s:21.1f}",
                flush=True,
            )


def timed(scenario: ScenarioConfig, options: SimulationOptions) -> tuple[float, float, float]:
    """Return the CPU time of a run, of its checkers and of the replay, in s.

    Raises
    ------
    SystemExit
        A checker has found something: a run that is wrong has no speed.
    """
    with ExitStack() as stack:
        with Stopwatch() as simulation:
            result = stack.enter_context(simulated(scenario, options))
        with Stopwatch() as checkers:
            found = check_invariants(result, replay=False)
        with Stopwatch() as replay:
            found += (each for log in result.master_logs for each in replay_mismatches(log))
    if found:
        sys.exit(f"{found[0].check}: {found[0].detail}")
    return simulation.cpu_s, checkers.cpu_s, replay.cpu_s
