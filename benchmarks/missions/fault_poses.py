"""Poses during faults of some kinds, against the truth: how many are valid, how far they are off, and what is violated.

    python benchmarks/run.py fault_poses KINDS SEED ... [--protocol P] [--estimator E] [--imu MODEL] [--stations N] [--duration S]

Each seed is a mission of the scenario `dynamic` as `tsgt simulate dynamic --faults KINDS --seed SEED` draws it. Counted are poses from the
start of each fault until 5 s after its end.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from measuring import normalised_squared

from tsgt.config import ClassicMasterConfig, SuperframeMasterConfig
from tsgt.estimation import centroid_at_point
from tsgt.geometry import log_so3, rotation_from_quaternion, transform_from, transform_points
from tsgt.log import configure_logging
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.faults import FAST_SYNC_CYCLES, draw_faults, parse_faults
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import find_scenario, with_stations

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.simulation.faults import Fault
    from tsgt.simulation.mission import MasterLog, MissionResult

AFTER_S = 5.0
LIMITS = (22.5, 60.0)
"""What one honest pose in a thousand, and one in 2e10, exceeds."""


def report(log: MasterLog, result: MissionResult, faults: Sequence[Fault]) -> None:
    """Print the events of a master, and a line for each of its series."""
    counts = Counter(event.event for event in log.events)
    print("  events:", ", ".join(f"{count} {event}" for event, count in counts.items()) or "none")
    poses = log.valid_poses()
    at_s = (poses.stamp_ns - log.unix_at_zero_ns) / 1e9
    during = np.zeros(len(at_s), dtype=np.bool_)
    for fault in faults:
        during |= (fault.at_s <= at_s) & (at_s <= fault.at_s + fault.duration_s + AFTER_S)
    poses, at_s = poses.select(during), at_s[during]
    truth = result.true_poses(at_s)
    estimated = transform_from(rotation_from_quaternion(poses.orientation_xyzw), poses.position_m)
    rotation = log_so3(estimated[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2))
    error = np.concatenate([estimated[:, :3, 3] - truth[:, :3, 3], rotation], axis=1)
    nees = normalised_squared(error, poses.covariance)
    centroid_m = centroid_at_point(result.parameters)
    error_m = np.linalg.norm(
        transform_points(estimated, centroid_m) - transform_points(truth, centroid_m), axis=1
    )
    error_rad = np.linalg.norm(rotation, axis=1)
    for series in np.unique(poses.series).tolist():
        of = poses.series == series
        above = [int(np.count_nonzero(nees[of] > limit)) for limit in LIMITS]
        print(
            f"  {series}: {np.count_nonzero(of)} valid during faults, at most {1e3 * error_m[of].max():.0f} mm at the centroid and "
            f"{1e3 * error_rad[of].max():.0f} mrad, NEES median {np.median(nees[of]):.1f}, {above[0]} above {LIMITS[0]}, "
            f"{above[1]} above {LIMITS[1]:g}"
        )


def main() -> None:
    """Run a mission for each seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("kinds")
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--protocol", choices=("superframe", "classic"), default="superframe")
    parser.add_argument("--estimator", choices=("linear", "continuous"), default="continuous")
    parser.add_argument("--imu", choices=("none", "industrial", "consumer"), default="none")
    parser.add_argument("--stations", type=int, default=3)
    parser.add_argument("--duration", type=float, default=130.0)
    options = parser.parse_args()
    configure_logging("critical")
    scenario = with_stations(find_scenario("dynamic"), options.stations)
    scenario = scenario.model_copy(
        update={
            "pipeline": scenario.pipeline.model_copy(update={"estimator": options.estimator}),
            "imu": scenario.imu.model_copy(update={"model": options.imu}),
        }
    )
    protocol: ClassicMasterConfig | SuperframeMasterConfig = SuperframeMasterConfig(kind="superframe")
    if options.protocol == "classic":
        protocol = ClassicMasterConfig(kind="classic", initial_cycles=FAST_SYNC_CYCLES)
    kinds = parse_faults(options.kinds)
    for seed in options.seeds:
        faults = draw_faults(
            kinds,
            np.random.default_rng([seed, 0xFA]),
            duration_s=options.duration,
            stations=[station.station for station in scenario.stations],
            imu=options.imu != "none",
        )
        mission = SimulationOptions(duration_s=options.duration, seed=seed, protocol=protocol, faults=kinds)
        print(f"seed {seed}: {', '.join(f'{each.kind} at {each.at_s:.0f} s' for each in faults)}", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            result = simulate(scenario, mission, folder=Path(folder))
            violations = check_invariants(result, replay=False)
        for log in result.master_logs:
            report(log, result, faults)
        for violation in violations:
            print(f"  VIOLATION {violation.check}: {violation.detail}")
