"""Consistency (NEES) of the covariances of the estimator `continuous`, for robots drawn from the motion prior.

For each kind of pose: the mean NEES over all robots with its 95 % band, and the share beyond the 95 % limit. Successive times
are not independent, so that each has its own band.

``set-up``: absolute poses, batch and live, where each run has its own set-up, drawn from its stated joint covariance (frames,
latencies, instrument errors, prisms, all correlated): with the full covariance and without the part that all poses of a run
share; and differences between two poses of a run, with the random part alone.

    python benchmarks/run.py nees [ROBOTS [SEED]]
    python benchmarks/run.py nees set-up [RUNS]
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from harness.drives.prior_motion import STEP_S, draw_motions, measure, rows_at, sorted_by_time
from harness.drives.scene import stationary_scene
from measuring import normalised_squared
from scipy.stats import chi2

from tsgt.estimation import parameter_names, setup_jacobian, uncertain_setup, with_setup
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.trajectory import FixedLagSmoother, Trajectory, initial_guess, knot_times, solve
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import Observations, SetupJacobian, States

ROBOTS = 400
UNTIL_S = 20.0
INSIDE_S = np.array([0.5, 2.0, 5.0, 8.0, 11.0, 14.0, 17.0, 19.5])
AHEAD_S = np.array([0.0, 0.1, 0.2, 0.5, 1.0, 2.0])
ONE_PRISM_S = (9.0, 10.5)
"""Stations 2 and 3 measure nothing in this interval."""

PARTS = {
    "position": slice(0, 3),
    "pose": slice(0, 6),
    "pose and velocity": slice(0, 12),
    "state": slice(0, 18),
}


def band(freedom: int, count: int) -> tuple[float, float]:
    """95 % band of the mean of so many NEES."""
    low, high = (float(chi2.ppf(share, freedom * count)) / count for share in (0.025, 0.975))
    return low, high


def known_set_up(robots: int, seed: int) -> None:
    """Print one table each for smoothed poses, predicted poses, and poses from one prism; each seed draws other robots."""
    prior = MotionPrior()
    tables: dict[str, tuple[str, np.ndarray]] = {
        "smoothed": ("at s", INSIDE_S),
        "predicted": ("s ahead", AHEAD_S),
        "one prism from 9 to 10.5 s": ("at s", np.array([8.9, 9.5, 10.0, 10.4, 11.0])),
    }
    found: dict[tuple[str, str], list[np.ndarray]] = {}
    start_s = time.process_time()
    for number, motion in enumerate(draw_motions(prior, count=robots, duration_s=UNTIL_S + 2.5, seed=seed)):
        whole = sorted_by_time(measure(motion, until_s=UNTIL_S, seed=number + robots * (seed - 1)))
        away = (whole.time_s > ONE_PRISM_S[0]) & (whole.time_s < ONE_PRISM_S[1]) & (whole.prism != 0)
        for name, (_, instants_s) in tables.items():
            observations = whole.select(~away) if name.startswith("one") else whole
            last_s = np.floor(observations.time_s[-1] / STEP_S) * STEP_S
            asked_s = instants_s + last_s if name == "predicted" else instants_s
            solution = solve(
                observations, initial_guess(observations, knot_times(observations.time_s)), prior
            )
            trajectory = Trajectory(solution.knots, prior, *solution.factor.marginals())
            states, covariance = trajectory.at(asked_s)
            error = motion.select(rows_at(asked_s)).local_coordinates_about(states)
            for part, rows in PARTS.items():
                found.setdefault((name, part), []).append(
                    normalised_squared(error[:, rows], covariance[:, rows, rows])
                )
    outside = total = 0
    for name, (unit, instants_s) in tables.items():
        print(f"{name}, {robots} robots: mean NEES, (share beyond the 95 % limit)")
        print(f"  {unit:>18} {'band':>13} " + " ".join(f"{instant:>13.1f}" for instant in instants_s))
        for part, rows in PARTS.items():
            freedom = rows.stop
            nees = np.array(found[name, part])
            low, high = band(freedom, robots)
            beyond = np.mean(nees > chi2.ppf(0.95, freedom), axis=0)
            means = nees.mean(axis=0)
            outside += int(np.count_nonzero((means < low) | (means > high)))
            total += len(means)
            cells = " ".join(f"{m:6.2f} ({b:4.1%})".rjust(13) for m, b in zip(means, beyond, strict=True))
            print(f"  {part:>18} {low:6.2f}-{high:5.2f} {cells}")
    print(f"{outside} of {total} means outside their 95 % band; {time.process_time() - start_s:.0f} s of CPU")


SETUP_RUNS = 200
SETUP_AT_S = np.array([4.0, 7.0, 10.0, 13.0, 16.0])
LAG_S = 3.0
FIRST_S = 10.0
APART_S = np.array([0.8, 1.0, 2.0, 4.0])
"""Of a difference: from two intervals of the measurements on, the random errors of two poses are hardly correlated."""
ASKED_S = np.union1d(SETUP_AT_S, np.append(FIRST_S, FIRST_S + APART_S))
REFINED = 0.2  # Of the sigmas, about what a refinement leaves
SETUP_SIGMAS = {  # About those of a calibration from targets at 20 to 100 m
    **dict.fromkeys(("x", "y", "z"), 2e-3),
    **dict.fromkeys(("rotation_x", "rotation_y", "rotation_z"), 5e-5),
    "latency": 1e-3,
    **dict.fromkeys(("vertical_index", "collimation"), 2.5e-5),
    "prism_constant": 5e-4,
    "range_scale": 2e-6,
}
PRISM_SIGMA_M = 1e-3
POSE = PARTS["pose"].stop


class Poses(NamedTuple):
    """Poses of one run at N times: error, covariance from the measurements, and from the set-up; rotations in world axes."""

    error: FloatArray  # (N, 6)
    random: FloatArray  # (N, 6, 6)
    common: FloatArray  # (N, 6, 6)

    @classmethod
    def of(cls, found: list[tuple[States, FloatArray, FloatArray | None]], motion: States) -> Poses:
        """Compare states with a motion."""
        parts = []
        for states, random, common in found:
            assert common is not None  # noqa: S101 (the set-up is uncertain)
            error = motion.select(rows_at(states.time_s)).local_coordinates_about(states)[:, :POSE]
            to_world = np.tile(np.eye(POSE), (len(error), 1, 1))
            to_world[:, 3:, 3:] = states.rotation
            turned = [to_world @ each @ np.swapaxes(to_world, 1, 2) for each in (random, common)]
            parts.append(((to_world @ error[:, :, None])[:, :, 0], *turned))
        return cls(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def joint_covariance(names: list[str]) -> FloatArray:
    """Covariance of a set-up with random correlations, the same for all runs."""
    kinds = [name.partition(".")[2] for name in names]
    sigmas = np.array([
        PRISM_SIGMA_M if name.startswith("prism") else SETUP_SIGMAS[kind]
        for name, kind in zip(names, kinds, strict=True)
    ])  # fmt: skip
    mixed = np.random.default_rng(0).normal(size=(len(names), 2 * len(names)))
    covariance = mixed @ mixed.T
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    return correlation * np.outer(sigmas, sigmas)


def batch_poses(
    observations: Observations, prior: MotionPrior, by_setup: SetupJacobian | None, motion: States
) -> Poses:
    """Poses as for a recording."""
    fit = fit_trajectory(observations, prior=prior, noise_scale=1.0, rest=(), setup_jacobian=by_setup)
    states, random = fit.trajectory.at(ASKED_S, dim=POSE)
    return Poses.of([(states, random, fit.trajectory.common_at(ASKED_S, dim=POSE))], motion)


def live_poses(
    observations: Observations, prior: MotionPrior, by_setup: SetupJacobian | None, motion: States
) -> Poses:
    """Poses that were smoothed as the measurements came."""
    smoother = FixedLagSmoother(prior, by_setup)
    due, found = list(ASKED_S), []
    for row in range(len(observations)):
        smoother.update(observations.select(slice(row, row + 1)))
        while due and observations.time_s[row] >= due[0] + LAG_S:
            at_s = np.array([due.pop(0)])
            trajectory = smoother.trajectory()
            found.append((*trajectory.at(at_s, dim=POSE), trajectory.common_at(at_s, dim=POSE)))
        smoother.marginalise_before(float(observations.time_s[row]) - LAG_S)
    return Poses.of(found, motion)


def print_header(title: str, columns: FloatArray) -> None:
    """Print the header of a table."""
    print(f"\n| {title} | " + " | ".join(f"{each:g}" for each in columns) + " |")
    print("|---|" + "---|" * len(columns))


def print_row(name: str, nees: FloatArray) -> None:
    """Print the means of NEES, (N, C), of C columns."""
    print(f"| {name} | " + " | ".join(f"{each:.2f}" for each in nees.mean(axis=0)) + " |")


def uncertain_set_up(runs: int) -> None:
    """Print the consistency of absolute poses and of differences."""
    prior, truth = MotionPrior(), stationary_scene().parameters
    layout = uncertain_setup(truth)
    names = parameter_names(layout, truth)
    root = layout.from_station_origins() @ np.linalg.cholesky(joint_covariance(names))
    poses: dict[str, list[Poses]] = defaultdict(list)
    start_s = time.process_time()
    for number, motion in enumerate(draw_motions(prior, count=runs, duration_s=UNTIL_S + 0.5, seed=3)):
        measured = sorted_by_time(measure(motion, until_s=UNTIL_S, seed=number))
        drawn = root @ np.random.default_rng([2, number]).normal(size=len(root))
        for name, share, estimate in (
            ("batch", 1.0, batch_poses),
            ("live, smoothed", 1.0, live_poses),
            ("batch, a fifth of these sigmas", REFINED, batch_poses),
        ):
            wrong = layout.retract(layout.reference, share * drawn)
            # The states here are not those of the prisms' centroid.
            given = replace(wrong, layout=wrong.layout + measured.layout - layout.reference.layout)
            by_setup = setup_jacobian(with_setup(truth, layout, wrong, share**2 * root @ root.T))
            poses[name].append(estimate(given.applied(measured), prior, by_setup, motion))
    low, high = band(POSE, runs)
    print(f"mean NEES over {runs} runs, 95 % band {low:.2f} to {high:.2f}\n")
    at = np.searchsorted(ASKED_S, SETUP_AT_S)
    first, second = np.searchsorted(ASKED_S, FIRST_S), np.searchsorted(ASKED_S, FIRST_S + APART_S)
    print_header("absolute poses, at s", SETUP_AT_S)
    for name, some in poses.items():
        error, random, common = (np.stack(each)[:, at] for each in zip(*some, strict=True))
        print_row(f"{name}, full covariance", normalised_squared(error, random + common))
        print_row(f"{name}, without the common part", normalised_squared(error, random))
    print_header("differences between two poses, s apart", APART_S)
    for name, some in poses.items():
        error, random, _ = (np.stack(each) for each in zip(*some, strict=True))
        apart = error[:, second] - error[:, [first]]
        print_row(
            f"{name}, random part alone", normalised_squared(apart, random[:, second] + random[:, [first]])
        )
    print(f"\n{time.process_time() - start_s:.0f} s of CPU")


def main() -> None:
    """Run what the first argument names."""
    if sys.argv[1:2] == ["set-up"]:
        uncertain_set_up(int(sys.argv[2]) if len(sys.argv) > 2 else SETUP_RUNS)
    else:
        arguments = [int(each) for each in sys.argv[1:]]
        known_set_up(*arguments, *(ROBOTS, 1)[len(arguments) :])
