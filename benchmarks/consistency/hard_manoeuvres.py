"""NEES of predicted poses during abrupt manoeuvres.

The robot of the scenario `dynamic` steps its speed and yaw rate at an unknown time. Three stations measure at 2.5 Hz;
measurements arrive together, 0.4 s apart and 0.15 to 0.3 s old. Poses are predicted twenty times a second, once by the prior
alone, once by the live estimator; those less certain than its default limits (0.1 m, 5 degrees) or more than 1.2 s from the
manoeuvre are omitted.

    python benchmarks/run.py hard_manoeuvres [ROBOTS]
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from harness.drives.manoeuvre import speeding_up_and_turning_back
from harness.drives.prior_motion import measure, rows_at, sorted_by_time

from tsgt.geometry.trajectory import FixedLagSmoother
from tsgt.model import MotionPrior

MANOEUVRES = {
    "turns back and speeds up": ((0.5, 1.5), (-0.5, 0.5)),
    "turns back and slows down": ((1.5, 0.5), (-0.5, 0.5)),
    "turns back at full speed": ((1.5, 1.5), (-0.5, 0.5)),
    "starts and turns": ((0.0, 1.5), (0.0, 0.5)),
    "stops in a turn": ((1.5, 0.0), (0.5, 0.0)),
}
STEP_TIME_S, UNTIL_S = 9.0, 11.0
BATCH_S, LAG_S, PERIOD_S = 0.4, 3.0, 0.05
NEAR_S = 1.2
LIMIT_M, LIMIT_RAD = 0.1, np.radians(5.0)
ABOVE = (22.46, 38.26, 60.0)


def predicted(name: str, seed: int) -> np.ndarray:
    """NEES of the poses near a manoeuvre, (N, 2), by the prior alone and by the live estimator; NaN if uncertain."""
    speeds_mps, rates_radps = MANOEUVRES[name]
    motion = speeding_up_and_turning_back(
        duration_s=UNTIL_S + 0.1, at_s=STEP_TIME_S, speeds_mps=speeds_mps, rates_radps=rates_radps
    )
    measured = sorted_by_time(measure(motion, until_s=UNTIL_S, seed=seed))
    random = np.random.default_rng([seed, 1])
    phase_s, delay_s = random.uniform(0, BATCH_S), random.uniform(0.15, 0.3)
    come_s = phase_s + BATCH_S * np.ceil((measured.time_s + delay_s - phase_s) / BATCH_S)
    window, taken, rows = FixedLagSmoother(MotionPrior()), 0, []
    for now_s in np.arange(1.0, STEP_TIME_S + NEAR_S, PERIOD_S):
        here = int(np.searchsorted(come_s, now_s, side="right"))
        if here > taken:
            window.update(measured.select(slice(taken, here)))
            window.marginalise_before(now_s - LAG_S)
            taken = here
        if now_s < STEP_TIME_S - NEAR_S or not window.converged or window.ambiguous:
            continue
        at_s = np.array([now_s])
        truth = motion.select(rows_at(at_s))
        ways = (window.trajectory().at(at_s, dim=6), window.predict(now_s, dim=6))
        rows.append(
            [_nees(state.local_coordinates_about(truth)[0, :6], covariance[0]) for state, covariance in ways]
        )
    return np.array(rows).reshape(-1, 2)


def _nees(error: np.ndarray, covariance: np.ndarray) -> float:
    sigma_m, sigma_rad = (
        float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (covariance[:3, :3], covariance[3:, 3:])
    )
    if sigma_m > LIMIT_M or sigma_rad > LIMIT_RAD:
        return np.nan
    return float(error @ np.linalg.solve(covariance, error))


def main() -> None:
    """Print a table."""
    robots = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    print(
        "manoeuvre, way: sure enough, largest NEES, how many in a million above " + ", ".join(map(str, ABOVE))
    )
    with ProcessPoolExecutor() as pool:
        for name in MANOEUVRES:
            every = np.concatenate(list(pool.map(predicted, [name] * robots, range(robots), chunksize=5)))
            for way, nees in zip(("by the prior alone", "as predicted"), every.T, strict=True):
                sure = nees[~np.isnan(nees)]
                above = ", ".join(f"{1e6 * np.mean(sure > limit):.0f}" for limit in ABOVE)
                print(f"{name}, {way}: {len(sure) / len(nees):.0%}, {sure.max():.0f}, {above}", flush=True)
