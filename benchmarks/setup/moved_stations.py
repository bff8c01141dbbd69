"""What the system does when a tripod moves or the robot rolls over: errors of valid poses, and what says so.

    python benchmarks/run.py moved_stations --estimator linear
    python benchmarks/run.py moved_stations --estimator continuous --only "turned by 0.5 mrad" "rolls over"

A mission of 90 s each, station 2 moves at 40 s, or the robot lies from 40 to 52 s. The figures stand in docs/explanation/faults.md,
section "Field days".
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import math
from functools import partial
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np
from measuring import simulated

from tsgt.estimation import centroid_at_point
from tsgt.geometry import log_so3, rotation_from_quaternion, transform_from, transform_points
from tsgt.simulation import runner
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.scenario_files import find_scenario, with_stations
from tsgt.simulation.world import Rollover

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from tsgt.simulation.mission import MasterLog, Mission, MissionResult

    Script = Callable[[Mission], Coroutine[None, None, None]]

DURATION_S, AT_S, STATION = 90.0, 40.0, 2
ROLLOVER = Rollover(AT_S, 1.5, AT_S + 12.0, math.radians(110.0))
EVENTS = (
    "layout_residual_high",
    "station_contradicted",
    "imu_not_used",
    "imu_setup_wrong",
    "instrument_status",
)


async def move(shift_mm: tuple[float, float, float], turn_mrad: float, mission: Mission) -> None:
    """Displace and turn the station at once."""
    await mission.sleep_until(AT_S)
    mission.move_station(STATION, [each / 1e3 for each in shift_mm], turn_mrad / 1e3)


async def creep(mm_per_min: float, mrad_per_min: float, mission: Mission) -> None:
    """Sink and turn slowly to the end."""
    await mission.sleep_until(AT_S)
    while mission.now_s < DURATION_S:
        await asyncio.sleep(1.0)
        mission.move_station(STATION, (0.0, 0.0, -mm_per_min / 60e3), mrad_per_min / 60e3)


async def nothing(_mission: Mission) -> None:
    """Leave the stations where they are."""


WHAT: dict[str, Script] = {
    "nothing moves": nothing,
    "sinks by 5 mm in a minute": partial(creep, 5.0, 0.0),
    "turns by 0.1 mrad in a minute": partial(creep, 0.0, 0.1),
    "kicked by 20 mm": partial(move, (0.0, 20.0, 0.0), 0.0),
    "turned by 0.5 mrad": partial(move, (0.0, 0.0, 0.0), 0.5),
    "kicked by 20 mm, 3 mrad": partial(move, (0.0, 20.0, 0.0), 3.0),
    "set up elsewhere": partial(move, (1500.0, 800.0, 100.0), 900.0),
    "rolls over": nothing,
}


def _rollovers(what: str, _faults: object) -> tuple[Rollover, ...]:
    return (ROLLOVER,) if what == "rolls over" else ()


def print_errors(log: MasterLog, result: MissionResult, from_s: float, to_s: float) -> None:
    """Print errors of the valid poses of a time, by series, at the prisms' centroid."""
    poses = log.valid_poses()
    at_s = (poses.stamp_ns - log.unix_at_zero_ns) / 1e9
    inside = (from_s <= at_s) & (at_s < to_s)
    poses, at_s = poses.select(inside), at_s[inside]
    truth = result.true_poses(at_s)
    T = transform_from(rotation_from_quaternion(poses.orientation_xyzw), poses.position_m)
    centroid_m = centroid_at_point(result.parameters)
    off_mm = 1e3 * np.linalg.norm(
        transform_points(T, centroid_m) - transform_points(truth, centroid_m), axis=1
    )
    turned = log_so3(T[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2))
    errors = np.concatenate([poses.position_m - truth[:, :3, 3], turned], axis=1)
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(poses.covariance, errors[..., None])[..., 0])
    off_deg = np.degrees(np.linalg.norm(turned, axis=1))
    for series in sorted(log.pose_counts):
        rows = poses.series == series
        share = np.count_nonzero(rows) / ((to_s - from_s) * 1e9 / result.parameters.pipeline.period_ns)
        text = f"    {series:12} {from_s:g} to {to_s:g} s: {share:4.0%} valid"
        if rows.any():
            text += (
                f", {np.mean(poses.good[rows]):4.0%} of them good; median and largest error {np.median(off_mm[rows]):.1f}, "
                f"{off_mm[rows].max():.1f} mm, {np.median(off_deg[rows]):.2f}, {off_deg[rows].max():.2f} deg; NEES "
                f"{np.median(nees[rows]):.0f}, {nees[rows].max():.0f}; of good ones {off_mm[rows][poses.good[rows]].max(initial=0):.1f} mm"
            )
        print(text)


def main() -> None:
    """Run the missions and print what happens."""
    logging.disable(logging.CRITICAL)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--estimator", default="linear")
    parser.add_argument("--imu", default="none")
    parser.add_argument("--stations", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(WHAT))
    arguments = parser.parse_args()
    scenario = find_scenario("dynamic")
    scenario = scenario.model_copy(
        update={
            "pipeline": scenario.pipeline.model_copy(update={"estimator": arguments.estimator}),
            "imu": scenario.imu.model_copy(update={"model": arguments.imu}),
        }
    )
    scenario = with_stations(scenario, arguments.stations)
    for what in arguments.only:
        options = SimulationOptions(duration_s=DURATION_S, seed=arguments.seed)
        # Instead of those that are drawn.
        drawn = patch.object(runner, "rollovers", partial(_rollovers, what))
        with drawn, simulated(scenario, options, script=WHAT[what]) as result:
            log = result.master_logs[-1]
            print(what, flush=True)
            for event in log.events:
                at_s = (event.stamp_ns - log.unix_at_zero_ns) / 1e9
                if event.event in EVENTS and at_s > AT_S:
                    print(f"    {at_s:.1f} s: {event.event} {event.station or ''} {event.message[:70]}")
            for from_s, to_s in ((AT_S, AT_S + 3.0), (AT_S + 3.0, AT_S + 15.0), (AT_S + 15.0, DURATION_S)):
                print_errors(log, result, from_s, to_s)
