"""Compare motion priors on recordings: white noise on acceleration, white noise on jerk, tuned correlation time.

For each recording and prior, sigmas and noise scale are tuned on the same segments. The table has the log evidence relative to
white noise on acceleration, and held-out prediction errors (folds as in `tsgt evaluate`; the prior is tuned without them).
Measurements at rest are left out: what is assumed there does not follow from the sigmas, but depends on the correlation time.

    python benchmarks/run.py motion_prior RECORDING...
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import (
    cross_validate,
    folds,
    interpolation_errors,
    training_rows,
    trajectory_errors,
)
from tsgt.analysis.evaluation.held_out import FOLDS
from tsgt.estimation import build_observations
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.batch.hyperparameters import log_parameters, maximise_evidence
from tsgt.geometry.rest import find_rest, in_rest
from tsgt.model import MotionPrior
from tsgt.recording import load_recording

if TYPE_CHECKING:
    from tsgt.analysis.evaluation import Fold
    from tsgt.geometry import FloatArray
    from tsgt.geometry.batch.hyperparameters import Hyperparameters
    from tsgt.geometry.trajectory import Observations

# An acceleration that lasts a millisecond is white at any rate of measuring; one of a minute, over the steps between
# measurements and over their neighbours', is the sum of white jerk.
CORRELATION_TIMES_S: dict[str, float | None] = {
    "white acceleration": 1e-3,
    "white jerk": 60.0,
    "tuned correlation": None,
}
FREE_TIME_S = (0.03, 10.0)
SIGMAS = (1e-3, 1e3)
SCALES = (0.5, 30.0)
TIME_SCALES = (0.05, 1.0)
_TIMES = (2, 5)


def tuned(observations: Observations, time_s: float | None) -> Hyperparameters:
    """Tune sigmas and noise scale with a given correlation time, or with the best."""
    start = log_parameters(MotionPrior(), np.ones((len(observations.frames), 3)))
    limits = [SIGMAS] * 6 + [SCALES] * (len(start) - 7) + [TIME_SCALES]
    for row in _TIMES:
        limits[row] = FREE_TIME_S if time_s is None else (time_s, time_s)
        if time_s is not None:
            # So that a step of 0.1 s has the same noise in its velocity to begin with.
            own_s = np.exp(start[row])
            gain = np.sqrt(own_s / time_s) if time_s < own_s else np.sqrt(time_s / own_s)
            start[row - 2 : row] += np.log(gain)
            start[row] = np.log(time_s)
    least, most = np.log(limits).T
    return maximise_evidence(observations, start, least, most)


def missed_m(observations: Observations, time_s: float | None) -> FloatArray:
    """Held-out prediction errors in m, without those at gaps."""
    seen = [
        tuned(observations.select(training_rows(observations, number)), time_s) for number in range(FOLDS)
    ]

    def by_fold(fold: Fold) -> FloatArray:
        own = seen[fold.number]
        kept = fit_trajectory(
            observations.select(fold.training), prior=own.prior, noise_scale=own.noise_scales
        )
        return trajectory_errors(kept.trajectory, observations.select(fold.test))

    held_out = cross_validate(folds(observations), by_fold)
    return held_out.error_m[~held_out.at_gap]


def row(name: str, evidence: str, missed: FloatArray, more: str = "") -> str:
    """Format one line of the table."""
    mean, p95 = 1e3 * missed.mean(), 1e3 * np.percentile(missed, 95)
    return f"  {name:20} {evidence:>9} {mean:8.1f} {p95:8.1f}  {more}"


def main() -> None:
    """Print one table per recording."""
    for path in sys.argv[1:]:
        recording = load_recording(Path(path))
        origin_ns = min(measurement.stamp_ns for measurement in recording.measurements)
        observations, _ = build_observations(
            recording.parameters, recording.measurements, origin_ns=origin_ns
        )
        observations = observations.select(in_rest(find_rest(observations), observations.time_s) < 0)
        print(f"{path}: {len(observations)} measurements, {np.ptp(observations.time_s):.0f} s")
        print(f"  {'prior':20} {'evidence':>9} {'mean mm':>8} {'p95 mm':>8}  tuned")
        least = np.nan
        for name, time_s in CORRELATION_TIMES_S.items():
            found = tuned(observations, time_s)
            least = found.log_evidence if np.isnan(least) else least
            prior = found.prior
            sigmas = ", ".join(
                f"{sigma:.3g}"
                for sigma in (
                    *prior.acceleration_sigma_mps2[1:],
                    *prior.angular_acceleration_sigma_radps2[1:],
                )
            )
            more = (
                f"{sigmas}; {prior.acceleration_correlation_time_s:.2g} and {prior.angular_acceleration_correlation_time_s:.2g} s; "
                f"noise x {found.noise_scale:.2f}"
            )
            evidence = f"{found.log_evidence - least:+.0f}"
            print(row(name, evidence, missed_m(observations, time_s), more), flush=True)
        lines = cross_validate(folds(observations), lambda fold: interpolation_errors(observations, fold))  # noqa: B023
        print(row("linear", "", lines.error_m[~lines.at_gap]), flush=True)
