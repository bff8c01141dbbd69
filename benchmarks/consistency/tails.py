"""Tails of the NEES of a robot that starts, stops and turns.

Batch poses of the robot of the scenario `dynamic`, whose motion is not Gaussian, measured three times 2.5 Hz, with the time
errors of the client's fit of the instrument's clock (benchmarks/instruments/instrument_time.py); clients and instruments restart every
ten minutes. Once with the stated time noise alone, once with that of the estimator.

    python benchmarks/run.py tails [HOURS] [FIRST_SEED]
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from instruments.instrument_time import Case, errors
from measuring import normalised_squared
from scipy.stats import chi2

from tsgt.config import ScenarioConfig
from tsgt.estimation.observations import FIRST_TIME_SIGMA_S, FIRST_TIMES, INSTRUMENT_TIME_SIGMA_S
from tsgt.geometry import (
    cartesian_to_polar,
    exp_so3,
    invert,
    log_so3,
    polar_to_cartesian,
    transform_from,
    transform_points,
)
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.trajectory import Observations
from tsgt.simulation.world import World, scenario_world

HOUR_S = 3600.0
RESTART_S = 600.0
STEP_S = 0.1
LIMITS = (22.46, 38.26, 60.0)
SCENARIO = ScenarioConfig()


def measured(world: World, seed: int) -> tuple[Observations, np.ndarray]:
    """Simulate an hour of measurements, and the number of each since its client's start."""
    random = np.random.default_rng([seed, 1])
    frames = np.array(
        [
            transform_from(exp_so3(np.array([0.0, 0.0, np.radians(each.yaw_deg)])), np.array(each.position_m))
            for each in SCENARIO.stations
        ]
    )
    rows = []
    for column, frame in enumerate(frames):
        for begin_s in np.arange(0.0, HOUR_S, RESTART_S):
            found = np.array(errors(Case("as in the scenario"), int(random.integers(2**32))))
            found = found[found[:, 0] < RESTART_S - 0.1]
            number, time_s = np.arange(len(found)), begin_s + found[:, 0] + random.uniform(0, 0.1)
            seen = transform_points(invert(frame), world.prism_at(time_s, column))
            horizontal, zenith, distance_m = cartesian_to_polar(seen)
            across_m = np.hypot(np.radians(1 / 3600) * distance_m, 1e-3)
            along_m = np.full(len(found), np.hypot(2e-3, 1e-3))
            noise = random.normal(size=(3, len(found)))
            points = polar_to_cartesian(
                horizontal + noise[0] * across_m / (distance_m * np.sin(zenith)),
                zenith + noise[1] * across_m / distance_m,
                distance_m + noise[2] * along_m,
            )
            stamp_s = time_s + 1e-3 * found[:, 1]
            rows.append(
                np.column_stack(
                    [stamp_s, number, np.full(len(found), column), points, along_m, across_m, across_m]
                )
            )
    table = np.concatenate(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    which = table[:, 2].astype(np.intp)
    observations = Observations(
        time_s=table[:, 0],
        time_sigma_s=np.zeros(len(table)),
        points_m=table[:, 3:6],
        sigmas_m=table[:, 6:9],
        polar=np.ones(len(table), dtype=bool),
        station=which,
        prism=which,
        frames=frames,
        layout=np.array([each.position_m for each in SCENARIO.prisms]),
    )
    return observations, table[:, 1]


def figures(observations: Observations, world: World) -> tuple[np.ndarray, np.ndarray]:
    """NEES and squared position errors in m^2 of all poses."""
    found = fit_trajectory(observations).trajectory
    times_s = np.arange(found.knots.time_s[0], found.knots.time_s[-1], STEP_S)
    states, covariance = found.at(times_s)
    truth = world.pose_at(times_s)
    off_m = truth[:, :3, 3] - states.position
    error = np.concatenate([off_m, log_so3(np.swapaxes(states.rotation, 1, 2) @ truth[:, :3, :3])], axis=1)
    return normalised_squared(error, covariance[:, :6, :6]), np.einsum("ni,ni->n", off_m, off_m)


def main() -> None:
    """Print a table after each hour."""
    hours, first = (int(each) for each in [*sys.argv[1:3], *("3", "0")[len(sys.argv) - 1 :]])
    kept: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {
        "at their word": [],
        "with what they leave out": [],
    }
    honest = ", ".join(f"{chi2.sf(limit, 6):.1e} above {limit}" for limit in LIMITS)
    print(f"honest: mean 6, {honest}")
    for seed in range(first, first + hours):
        world = scenario_world(SCENARIO, HOUR_S, np.random.default_rng(seed))
        observations, number = measured(world, seed)
        sigma_s = np.hypot(INSTRUMENT_TIME_SIGMA_S, FIRST_TIME_SIGMA_S / np.sqrt(1 + number / FIRST_TIMES))
        kept["at their word"].append(figures(observations, world))
        kept["with what they leave out"].append(figures(replace(observations, time_sigma_s=sigma_s), world))
        print(f"{seed - first + 1} h")
        for name, parts in kept.items():
            nees, squares = (np.concatenate(each) for each in zip(*parts, strict=True))
            shares = ", ".join(f"{np.mean(nees > limit):.1e} above {limit}" for limit in LIMITS)
            rms_mm = 1e3 * np.sqrt(squares.mean())
            print(
                f"  {name}: {rms_mm:.2f} mm rms at the robot's origin, NEES: mean {nees.mean():.2f}, {shares}, "
                f"largest {nees.max():.0f}",
                flush=True,
            )
