"""Rest: what is taken for rest, and what it is worth; errors at rest and moving, held-out prediction at rest and moving.

Without arguments: a minute each of robots that stand, creep, rock or vibrate, by the share that is taken for rest; then drives of
`dynamic`, measured straight from the ground truth, with and without rest. With recordings: their held-out prediction errors.

    python benchmarks/run.py rest [RECORDING...]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from harness.drives.prior_motion import CENTRE_M
from harness.drives.scene import FRAMES
from harness.drives.slow_motion import LINE_OF_SIGHT, creeping, measure_along
from measuring import normalised_squared

from tsgt.analysis.evaluation import (
    cross_validate,
    folds,
    interpolation_errors,
    training_rows,
    trajectory_errors,
)
from tsgt.analysis.smoothing import estimate_motion_model
from tsgt.analysis.validation import plausible_measurements
from tsgt.estimation import build_observations
from tsgt.geometry import cartesian_to_polar, invert, log_so3, polar_to_cartesian, transform_points
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.rest import find_rest, in_rest
from tsgt.geometry.trajectory import FixedLagSmoother, Observations
from tsgt.model import MotionPrior
from tsgt.recording import load_recording
from tsgt.simulation.scenario_files import find_scenario
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.analysis.evaluation import Fold
    from tsgt.geometry import FloatArray
    from tsgt.simulation.world import World

ROBOTS, FITTED, MINUTE_S = 20, 5, 60.0
SEEDS, DRIVE_S = (1, 2, 3), 600.0
RANGE_SIGMA_M, POINTING_SIGMA_M, ANGLE_SIGMA_RAD, TIME_SIGMA_S = 0.002, 0.001, np.radians(1 / 3600), 6e-4
INTERVAL_S, TICK_JITTER_S = 0.4, 0.004
POSITION_95 = 7.815  # Of the chi-square distribution with 3 degrees of freedom
POSE_999 = 22.46  # The 99.9 % point with 6
LIVE, LAG_S, SETTLED_S = 3, 3.0, 15.0


def rocking(amplitude_m: float, frequency_hz: float) -> Callable[[FloatArray], FloatArray]:
    """Displacement of a robot that rocks."""
    return lambda time_s: amplitude_m * np.sin(2 * np.pi * frequency_hz * time_s)


def share_at_rest(
    along_m: Callable[[FloatArray], FloatArray],
    *,
    vibration_m: float = 0.0,
    stations: Sequence[int] = (0, 1, 2),
) -> float:
    """Share of a minute that is taken for rest, mean over robots."""
    total_s = 0.0
    for seed in range(ROBOTS):
        observations = measure_along(
            along_m, until_s=MINUTE_S, seed=seed, vibration_m=vibration_m, stations=stations
        )
        total_s += sum(each.end_s - each.start_s for each in find_rest(observations))
    return total_s / ROBOTS / MINUTE_S


def rocking_errors(along_m: Callable[[FloatArray], FloatArray]) -> str:
    """Errors of the poses of robots that rock for a minute, where they are taken for rest; at the prisms' centroid."""
    errors, nees = [], []
    for seed in range(FITTED):
        found = fit_trajectory(
            measure_along(along_m, until_s=MINUTE_S, seed=seed), prior=MotionPrior(), noise_scale=1.0
        )
        at_s = np.arange(2.0, MINUTE_S - 2.0, 0.05)
        at_s = at_s[in_rest(found.rest, at_s) >= 0]
        states, covariance = found.trajectory.at(at_s, dim=6)
        truth = np.tile(CENTRE_M, (len(at_s), 1))
        truth[:, :2] += along_m(at_s)[:, None] * LINE_OF_SIGHT
        errors.append(np.linalg.norm(states.position - truth, axis=1))
        nees.append(normalised_squared(states.position - truth, covariance[:, :3, :3]))
    error_mm, beyond = 1e3 * np.concatenate(errors), np.concatenate(nees) > POSITION_95
    return f"{np.sqrt(np.mean(error_mm**2)):.2f} | {error_mm.max():.1f} | {beyond.mean():.1%}"


def live_rocking_errors(along_m: Callable[[FloatArray], FloatArray]) -> str:
    """Errors of the final live poses of robots that rock for a minute, from when the window is full; at the prisms' centroid."""
    errors, nees = [], []
    for seed in range(LIVE):
        observations = measure_along(along_m, until_s=MINUTE_S, seed=seed)
        smoother = FixedLagSmoother(MotionPrior())
        for row, now_s in enumerate(observations.time_s.tolist()):
            smoother.update(observations.select(slice(row, row + 1)))
            if now_s > SETTLED_S and row % 3 == 0:
                states, covariance = smoother.smoothed_trajectory().at(np.array([now_s - LAG_S]), dim=6)
                truth = CENTRE_M.copy()
                truth[:2] += along_m(now_s - LAG_S) * LINE_OF_SIGHT
                error = np.concatenate([states.position - truth, log_so3(states.rotation)], axis=1)
                errors.append(np.linalg.norm(error[:, :3], axis=1))
                nees.append(normalised_squared(error, covariance))
            smoother.marginalise_before(now_s - LAG_S)
    error_mm, beyond = 1e3 * np.concatenate(errors), np.concatenate(nees) > POSE_999
    return f"{np.sqrt(np.mean(error_mm**2)):.2f} | {error_mm.max():.1f} | {beyond.mean():.1%}"


def measured_drive(seed: int) -> tuple[World, Observations]:
    """Ten minutes of the scenario `dynamic`, with its noise."""
    rng = np.random.default_rng(seed)
    world = scenario_world(find_scenario("dynamic"), DRIVE_S, rng.spawn(1)[0])
    ticks_s = np.arange(INTERVAL_S / 2, DRIVE_S - 1.0, INTERVAL_S)
    time_s = (
        ticks_s[:, None] + rng.uniform(0, INTERVAL_S, 3) + rng.normal(0, TICK_JITTER_S, (len(ticks_s), 3))
    ).ravel()
    prism = np.tile(np.arange(3), len(ticks_s))
    order = np.argsort(time_s)
    time_s, prism = time_s[order], prism[order]
    poses = world.pose_at(time_s)
    points = transform_points(invert(FRAMES)[prism], transform_points(poses, world.prisms_m[prism]))
    points += rng.normal(0, POINTING_SIGMA_M, points.shape)
    horizontal, zenith, distance = cartesian_to_polar(points)
    sigmas = np.empty_like(points)
    sigmas[:, 0] = np.hypot(RANGE_SIGMA_M, POINTING_SIGMA_M)
    sigmas[:, 1:] = np.hypot(ANGLE_SIGMA_RAD * distance, POINTING_SIGMA_M)[:, None]
    angles = rng.normal(0, ANGLE_SIGMA_RAD, (2, len(time_s)))
    noisy = polar_to_cartesian(
        horizontal + angles[0], zenith + angles[1], distance + rng.normal(0, RANGE_SIGMA_M, len(time_s))
    )
    stamps_s = time_s + rng.normal(0, TIME_SIGMA_S, len(time_s))
    observations = Observations(
        time_s=stamps_s,
        time_sigma_s=np.full(len(time_s), TIME_SIGMA_S),
        points_m=noisy,
        sigmas_m=sigmas,
        polar=np.ones(len(time_s), dtype=bool),
        station=prism,
        prism=prism,
        frames=FRAMES,
        layout=world.prisms_m - world.prisms_m.mean(axis=0),
    )
    return world, observations.select(np.argsort(stamps_s))


def drive(seed: int) -> None:
    """Print errors of one drive, at the prisms' centroid."""
    world, observations = measured_drive(seed)
    at_s = np.arange(2.0, DRIVE_S - 2.0, 0.05)
    truth, later = (world.pose_at(each) for each in (at_s, at_s + 0.01))
    standing = np.abs(later - truth).max(axis=(1, 2)) < 1e-5
    centroid = world.prisms_m.mean(axis=0)
    for label, rest in (("moving everywhere", ()), ("with rest", None)):
        found = fit_trajectory(observations, rest=rest)
        states, covariance = found.trajectory.at(at_s, dim=6)
        error = np.concatenate(
            [
                transform_points(truth, centroid) - states.position,
                log_so3(np.swapaxes(states.rotation, 1, 2) @ truth[:, :3, :3]),
            ],
            axis=1,
        )
        nees = normalised_squared(error, covariance)
        for part, rows in (("all", np.ones_like(standing)), ("at rest", standing), ("moving", ~standing)):
            rms_mm = 1e3 * np.sqrt(np.mean(np.sum(error[rows, :3] ** 2, axis=1)))
            rms_deg = np.degrees(np.sqrt(np.mean(np.sum(error[rows, 3:] ** 2, axis=1))))
            print(
                f"| {seed} | {label} | {part} | {np.mean(rows):.0%} | {rms_mm:.2f} mm, {rms_deg:.3f}° "
                f"| {nees[rows].mean():.1f} | {nees[rows].max():.0f} | {1e3 * np.mean(nees[rows] > 22.46):.1f} |",
                flush=True,
            )


def held_out(path: Path) -> None:
    """Print held-out prediction errors of a recording, at rest and moving."""
    recording = load_recording(path)
    measurements = plausible_measurements(recording)
    origin_ns = min(measurement.stamp_ns for measurement in measurements)
    observations, _ = build_observations(recording.parameters, measurements, origin_ns=origin_ns)
    splits, pipeline = folds(observations), recording.parameters.pipeline
    motions = {
        number: estimate_motion_model(observations.select(training_rows(observations, number)), pipeline)
        for number in {each.number for each in splits}
    }

    def smoothed(fold: Fold) -> FloatArray:
        motion = motions[fold.number]
        found = fit_trajectory(
            observations.select(fold.training),
            prior=motion.prior,
            occluded_prior=pipeline.motion,
            noise_scale=motion.noise_scales,
        )
        return trajectory_errors(found.trajectory, observations.select(fold.test))

    at_rest = np.concatenate(
        [in_rest(find_rest(observations), observations.time_s[each.test]) >= 0 for each in splits]
    )
    lines = cross_validate(splits, lambda fold: interpolation_errors(observations, fold))
    curve = cross_validate(splits, smoothed)
    for part, rows in (("at rest", at_rest & ~lines.at_gap), ("moving", ~at_rest & ~lines.at_gap)):
        if not rows.any():
            continue
        figures = " | ".join(
            f"{1e3 * of(lines.error_m[rows]):.2f} | {1e3 * of(curve.error_m[rows]):.2f} "
            f"| {of(curve.error_m[rows]) / of(lines.error_m[rows]):.2f}"
            for of in (np.median, np.mean)
        )
        print(f"| {path.stem} | {part} | {np.count_nonzero(rows)} | {figures} |", flush=True)


def main() -> None:
    """Print the tables."""
    if sys.argv[1:]:
        print(
            "| recording | part | points | p50 lines | continuous | ratio | mean lines | continuous | ratio |"
        )
        for each in sys.argv[1:]:
            held_out(Path(each))
        return
    still = creeping(0.0)
    print("| a minute of a robot that | rms mm | largest mm | outside the 95 % ellipsoid |")
    print(f"| stands | {rocking_errors(still)} |")
    for amplitude_mm, frequency_hz in ((1, 0.2), (1, 1.0), (2, 0.2), (2, 1.0)):
        errors = rocking_errors(rocking(amplitude_mm / 1e3, frequency_hz))
        print(f"| rocks by {amplitude_mm} mm at {frequency_hz} Hz | {errors} |", flush=True)
    print("| live, a minute of a robot that | rms mm | largest mm | NEES above 22.5 |")
    print(f"| stands | {live_rocking_errors(still)} |")
    for amplitude_mm, frequency_hz in ((1, 0.2), (1, 1.0), (2, 0.2), (2, 1.0)):
        errors = live_rocking_errors(rocking(amplitude_mm / 1e3, frequency_hz))
        print(f"| rocks by {amplitude_mm} mm at {frequency_hz} Hz | {errors} |", flush=True)
    print("| a minute of a robot that | taken for rest |")
    print(f"| stands | {share_at_rest(still):.1%} |")
    print(f"| stands, two stations out | {share_at_rest(still, stations=(1,)):.1%} |")
    for vibration_mm in (1, 2, 3):
        print(
            f"| stands, vibrates by {vibration_mm} mm | {share_at_rest(still, vibration_m=vibration_mm / 1e3):.1%} |"
        )
    for speed_mmps in (3, 5, 10, 20):
        print(f"| creeps at {speed_mmps} mm/s | {share_at_rest(creeping(speed_mmps / 1e3)):.1%} |")
    for amplitude_mm in (2, 4):
        for frequency_hz in (0.2, 1.0):
            share = share_at_rest(rocking(amplitude_mm / 1e3, frequency_hz))
            print(f"| rocks by {amplitude_mm} mm at {frequency_hz} Hz | {share:.1%} |")
    print("| seed | trajectory | part | share | rms | NEES, mean | largest | above 22.5 in 1000 |")
    for seed in SEEDS:
        drive(seed)
