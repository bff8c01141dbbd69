"""Consistency (NEES) of the covariances of the estimator `continuous`, for robots drawn from the motion prior.

For each kind of pose: the mean NEES over all robots with its 95 % band, and the share beyond the 95 % limit. Successive times
are not independent, so that each has its own band.

    python benchmarks/run.py nees [ROBOTS]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from harness.prior_motion import STEP_S, draw_motions, measure, rows_at, sorted_by_time
from measuring import normalised_squared
from scipy.stats import chi2

from tsgt.geometry.trajectory import Trajectory, initial_guess, knot_times, solve
from tsgt.model import MotionPrior

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


def main() -> None:
    """Print one table each for smoothed poses, predicted poses, and poses from one prism."""
    robots = int(sys.argv[1]) if len(sys.argv) > 1 else ROBOTS
    prior = MotionPrior()
    tables: dict[str, tuple[str, np.ndarray]] = {
        "smoothed": ("at s", INSIDE_S),
        "predicted": ("s ahead", AHEAD_S),
        "one prism from 9 to 10.5 s": ("at s", np.array([8.9, 9.5, 10.0, 10.4, 11.0])),
    }
    found: dict[tuple[str, str], list[np.ndarray]] = {}
    start_s = time.process_time()
    for number, motion in enumerate(draw_motions(prior, count=robots, duration_s=UNTIL_S + 2.5, seed=1)):
        whole = sorted_by_time(measure(motion, until_s=UNTIL_S, seed=number))
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
            low, high = (float(chi2.ppf(share, freedom * robots)) / robots for share in (0.025, 0.975))
            beyond = np.mean(nees > chi2.ppf(0.95, freedom), axis=0)
            means = nees.mean(axis=0)
            outside += int(np.count_nonzero((means < low) | (means > high)))
            total += len(means)
            cells = " ".join(f"{m:6.2f} ({b:4.1%})".rjust(13) for m, b in zip(means, beyond, strict=True))
            print(f"  {part:>18} {low:6.2f}-{high:5.2f} {cells}")
    print(f"{outside} of {total} means outside their 95 % band; {time.process_time() - start_s:.0f} s of CPU")
