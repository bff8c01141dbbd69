"""Tuned noise against the truth, and held-out errors in sigmas.

    python benchmarks/run.py noise simulated [SEEDS] [SECONDS]
    python benchmarks/run.py noise prior [SEEDS]
    python benchmarks/run.py noise held-out RECORDING...

``simulated``: the robot of the scenario `dynamic`, measured three times 2.5 Hz with white noise as stated, with the time errors
of the client's fit of the instrument's clock (benchmarks/instruments/instrument_time.py) and the time noise that the estimator assumes.
The truth is the root mean square of the noise that was drawn over what is stated. ``prior``: robots that move as the motion prior
says, without a stop, for 42 s each; the prior tuned, and given. ``held-out``: by component, moving and
at rest; near a loss of lock apart.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from harness.drives.prior_motion import draw_motions, measure, sorted_by_time
from instruments.instrument_time import Case, errors
from measuring import normalised_squared

from tsgt.analysis.diagnosis.noise_factors import near_gaps
from tsgt.analysis.evaluation import held_out_errors
from tsgt.config import ScenarioConfig, level_frame
from tsgt.estimation import build_observations, instrument_time_sigma_s
from tsgt.geometry import cartesian_to_polar, invert, log_so3, polar_to_cartesian, transform_points
from tsgt.geometry.batch import TrajectoryFit, fit_trajectory, tune
from tsgt.geometry.trajectory import Observations
from tsgt.model import MotionPrior
from tsgt.recording import load_recording
from tsgt.simulation.world import World, scenario_world

SCENARIO = ScenarioConfig()
STEP_S = 0.1
MARGIN_S = 2.0
LIMITS = (22.46, 38.26)


class Drive(NamedTuple):
    """Measurements, and the noise that they have over the noise that is stated."""

    observations: Observations
    true_scale: float


def measured(world: World, duration_s: float, seed: int) -> Drive:
    """Measure each prism by its station."""
    random = np.random.default_rng([seed, 1])
    frames = np.array([level_frame(each) for each in SCENARIO.stations])
    layout = np.array([each.position_m for each in SCENARIO.prisms])
    rows, drawn = [], []
    for column, frame in enumerate(frames):
        found = np.array(errors(Case("as in the scenario"), int(random.integers(2**32))))
        found = found[found[:, 0] < duration_s - STEP_S]
        time_s = found[:, 0] + random.uniform(0.0, STEP_S)
        seen = transform_points(invert(frame), world.prism_at(time_s, column))
        horizontal, zenith, distance_m = cartesian_to_polar(seen)
        across_m = np.hypot(np.radians(1 / 3600) * distance_m, 1e-3)
        along_m = np.full(len(found), np.hypot(2e-3, 1e-3))
        noise = random.normal(size=(3, len(found)))
        drawn.append(noise.ravel())
        points = polar_to_cartesian(
            horizontal + noise[1] * across_m / (distance_m * np.sin(zenith)),
            zenith + noise[2] * across_m / distance_m,
            distance_m + noise[0] * along_m,
        )
        time_sigma_s = [instrument_time_sigma_s(number) for number in range(len(found))]
        stamp_s = time_s + 1e-3 * found[:, 1]
        which = np.full(len(found), column)
        rows.append(np.column_stack([stamp_s, time_sigma_s, which, points, along_m, across_m, across_m]))
    table = np.concatenate(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    which = table[:, 2].astype(np.intp)
    observations = Observations(
        time_s=table[:, 0],
        time_sigma_s=table[:, 1],
        points_m=table[:, 3:6],
        sigmas_m=table[:, 6:9],
        polar=np.ones(len(table), dtype=bool),
        station=which,
        prism=which,
        frames=frames,
        layout=layout - layout.mean(axis=0),
    )
    return Drive(observations, float(np.sqrt(np.mean(np.concatenate(drawn) ** 2))))


def pose_errors(fit: TrajectoryFit, world: World) -> tuple[np.ndarray, np.ndarray]:
    """(N, 6) errors of position (at the prisms' centroid) and rotation, and their NEES."""
    knots_s = fit.trajectory.knots.time_s
    time_s = np.arange(knots_s[0] + MARGIN_S, knots_s[-1] - MARGIN_S, STEP_S)
    states, covariance = fit.trajectory.at(time_s, dim=6)
    truth = world.pose_at(time_s)
    centroid = np.array([each.position_m for each in SCENARIO.prisms]).mean(axis=0)
    position = truth[:, :3, 3] + truth[:, :3, :3] @ centroid - states.position
    rotation = log_so3(np.swapaxes(states.rotation, 1, 2) @ truth[:, :3, :3])
    error = np.concatenate([position, rotation], axis=1)
    return error, normalised_squared(error, covariance)


def simulated(seeds: int, duration_s: float) -> None:
    """Print one row per seed, and the means."""
    print(
        "| seed | noise found / true | lowest | highest | NEES (6) | above 22.5, 38.3 in 1000 | mm | degrees |"
    )
    print("|---|---|---|---|---|---|---|---|")
    ratios = []
    for seed in range(1, seeds + 1):
        world = scenario_world(SCENARIO, duration_s, np.random.default_rng(seed))
        drive = measured(world, duration_s, seed)
        tuned = tune(drive.observations)
        fit = fit_trajectory(drive.observations, prior=tuned.prior, noise_scale=tuned.noise_scales)
        error, nees = pose_errors(fit, world)
        ratios.append(tuned.noise_scale / drive.true_scale)
        shares = " and ".join(f"{1e3 * np.mean(nees > limit):.1f}" for limit in LIMITS)
        position_mm = 1e3 * np.sqrt(np.mean(np.sum(error[:, :3] ** 2, axis=1)))
        rotation_deg = np.degrees(np.sqrt(np.mean(np.sum(error[:, 3:] ** 2, axis=1))))
        print(
            f"| {seed} | {ratios[-1]:.3f} | {tuned.noise_scales.min():.2f} | {tuned.noise_scales.max():.2f} | "
            f"{nees.mean():.2f} | {shares} | {position_mm:.2f} | {rotation_deg:.3f} |",
            flush=True,
        )
    print(f"found / true: {np.mean(ratios):.3f} on average")


def of_prior(seeds: int) -> None:
    """Print the noise found where the truth is 1, by seed, and the means."""
    prior, found = MotionPrior(), []
    print("| seed | prior tuned | prior given |")
    print("|---|---|---|")
    for seed in range(1, seeds + 1):
        (motion,) = draw_motions(prior, count=1, duration_s=43.0, seed=seed)
        observations = sorted_by_time(measure(motion, until_s=42.0, seed=seed))
        scales = [
            tune(observations).noise_scale,
            tune(observations, start=prior, noise_only=True).noise_scale,
        ]
        found.append(scales)
        print(f"| {seed} | {scales[0]:.3f} | {scales[1]:.3f} |", flush=True)
    tuned, given = np.mean(found, axis=0)
    print(f"on average {tuned:.3f} and {given:.3f}, standard deviations {np.std(found, axis=0).round(3)}")


def held_out(path: Path) -> None:
    """Print held-out errors in sigmas by station and component."""
    recording = load_recording(path)
    origin_ns = min(measurement.stamp_ns for measurement in recording.measurements)
    observations, _ = build_observations(recording.parameters, recording.measurements, origin_ns=origin_ns)
    found = held_out_errors(observations, recording.parameters)
    continuous, linear = found["continuous"].statistics, found["linear"].statistics
    print(
        f"{path}: held-out mean {continuous.mean:.2f} of {linear.mean:.2f} mm ({continuous.mean / linear.mean:.2f}), 95 % "
        f"{continuous.p95:.1f} of {linear.p95:.1f} mm ({continuous.p95 / linear.p95:.2f})"
    )
    normalised = found["continuous"].normalised
    if normalised is None:
        return
    rows, at_rest = normalised.rows, normalised.stationary
    near = near_gaps(observations)[0][rows]
    inside = ~found["continuous"].at_gap
    print("| part | component | rms | without tails | beyond 3.29 sigmas, of 1000 | n |")
    print("|---|---|---|---|---|---|")
    moving = inside & ~at_rest & ~near
    parts = {
        "moving": moving,
        "moving, near a loss of lock": inside & ~at_rest & near,
        "at rest": inside & at_rest,
    }
    for station in np.unique(observations.station[rows]):
        parts[f"moving, station {station + 1}"] = moving & (observations.station[rows] == station)
    for name, part in parts.items():
        for of, each in normalised.statistics(part).items():
            print(
                f"| {name} | {of.replace('_', ' ')} | {each.rms:.2f} | {each.robust:.2f} | "
                f"{1e3 * each.beyond_3_29_sigma:.1f} | {each.n} |",
                flush=True,
            )


def main() -> None:
    """Run what the first argument names."""
    if sys.argv[1:2] == ["held-out"]:
        for path in sys.argv[2:]:
            held_out(Path(path))
    elif sys.argv[1:2] == ["prior"]:
        of_prior(int((*sys.argv[2:3], "8")[0]))
    else:
        seeds, duration_s = (
            float(each) for each in [*sys.argv[2:4], *("6", "300")[max(len(sys.argv) - 2, 0) :]]
        )
        simulated(int(seeds), duration_s)


if __name__ == "__main__":
    main()
