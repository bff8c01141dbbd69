"""Predictions of the fixed-lag smoother: process-noise scale, NIS scaling, manoeuvres."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.manoeuvre import speeding_up_and_turning_back
from harness.drives.prior_motion import draw_motions, measure, rows_at, sorted_by_time

from tsgt.geometry.trajectory import FixedLagSmoother, Observations
from tsgt.geometry.trajectory.fixed_lag import PREDICTION_NOISE_SCALE
from tsgt.geometry.trajectory.propagation import Propagator
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

PRIOR = MotionPrior()
LAG_S = 3.0
AHEAD_S = 0.3
LATEST_S = 0.8
"""Largest age of the newest measurement, sent once per superframe."""


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Twelve seconds of a robot that moves as the prior says."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=12.0, seed=1)
    return sorted_by_time(measure(motion, until_s=12.0, seed=1))


def run_smoother(observations: Observations) -> FixedLagSmoother:
    """Update measurement by measurement, with a fixed lag."""
    window = FixedLagSmoother(PRIOR)
    for row in range(len(observations)):
        window.update(observations.select(slice(row, row + 1)))
        window.marginalise_before(observations.time_s[row] - LAG_S)
    return window


def covariance_without_nis_scale(window: FixedLagSmoother, at_s: float) -> FloatArray:
    """Covariance of the prediction with the process-noise scale alone."""
    trajectory = window.trajectory()
    end_s = trajectory.knots.time_s[-1:]
    state, covariance = trajectory.at(end_s)
    return Propagator(state, covariance[0], PRIOR, process_noise_scale=PREDICTION_NOISE_SCALE).at(at_s)[1]


@pytest.mark.slow
def test_large_innovations_increase_predicted_covariance(observations: Observations) -> None:
    """The robot doubles its speed between measurements."""
    hurried_s = np.where(
        observations.time_s < 6.0, observations.time_s, 6.0 + (observations.time_s - 6.0) / 2.0
    )
    ratios = []
    for time_s in (observations.time_s, hurried_s):
        window = run_smoother(replace(observations, time_s=time_s).select(time_s < 6.4))
        at_s = float(time_s[time_s < 6.4][-1]) + AHEAD_S
        _, covariance = window.predict(at_s)
        ratios.append(
            float(np.trace(covariance[0]) / np.trace(covariance_without_nis_scale(window, at_s)[0]))
        )
    assert ratios[0] == pytest.approx(1.0)
    assert ratios[1] > 2.0


@pytest.mark.slow
def test_outlier_leaves_predicted_covariance_unchanged(observations: Observations) -> None:
    """A rejected measurement says nothing about the motion."""
    row = len(observations) - 3
    for off_m in (0.3, 30.0):
        points = observations.points_m.copy()
        points[row] *= 1 + off_m / np.linalg.norm(points[row])
        window = run_smoother(replace(observations, points_m=points))
        at_s = float(observations.time_s[-1]) + AHEAD_S
        np.testing.assert_allclose(
            window.predict(at_s)[1], covariance_without_nis_scale(window, at_s), rtol=1e-6
        )


@pytest.mark.slow
def test_predictions_cover_abrupt_manoeuvres() -> None:
    """Manoeuvres that begin right after the last measurements stay within the predicted covariance."""
    motion = speeding_up_and_turning_back(
        duration_s=10.0, at_s=8.0, speeds_mps=(0.5, 1.5), rates_radps=(-0.5, 0.5)
    )
    largest = []
    for seed in range(6):
        measured = sorted_by_time(measure(motion, until_s=9.0, seed=seed))
        found = []
        for last_s in np.arange(7.6, 8.4, 0.1):
            window = run_smoother(measured.select(measured.time_s < last_s))
            for ahead_s in np.arange(0.2, LATEST_S, 0.1):
                at = np.array([last_s + ahead_s])
                state, covariance = window.predict(float(at[0]), dim=6)
                error = state.local_coordinates_about(motion.select(rows_at(at)))[0, :6]
                found.append(float(error @ np.linalg.solve(covariance[0], error)))
        largest.append(max(found))
    # Squared errors in sigmas. By the prior alone, which knows no such robot, the mean of these is 40.
    assert np.mean(largest) < 36.0
