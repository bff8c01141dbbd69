"""What the fixed lag says of where nothing was measured yet: as uncertain as a robot that may do something else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.manoeuvre import speeding_up_and_turning_back
from harness.prior_motion import draw_motions, measure, rows_at, sorted_by_time

from tsgt.geometry import FixedLagSmoother, FloatArray, Observations
from tsgt.geometry.trajectory.fixed_lag import PREDICTION_NOISE_SCALE
from tsgt.geometry.trajectory.propagation import Propagator
from tsgt.model import MotionPrior

PRIOR = MotionPrior()
LAG_S = 3.0
AHEAD_S = 0.3
LATEST_S = 0.8
"""So old may the newest measurement be, sent once in a superframe."""


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Twelve seconds of a robot that moves as the prior says."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=12.0, seed=1)
    return sorted_by_time(measure(motion, until_s=12.0, seed=1))


def followed(observations: Observations) -> FixedLagSmoother:
    """One by one; what is older than the lag is let go of."""
    window = FixedLagSmoother(PRIOR)
    for row in range(len(observations)):
        window.update(observations.select(slice(row, row + 1)))
        window.marginalise_before(observations.time_s[row] - LAG_S)
    return window


def without_surprise(window: FixedLagSmoother, at_s: float) -> FloatArray:
    """Return the covariance of the state at an instant, of a robot that is livelier from the last measurement on."""
    trajectory = window.trajectory()
    end_s = trajectory.knots.time_s[-1:]
    state, covariance = trajectory.at(end_s)
    return Propagator(state, covariance[0], PRIOR, process_noise_scale=PREDICTION_NOISE_SCALE).at(at_s)[1]


def test_a_robot_that_does_the_unexpected_is_predicted_with_less_certainty(
    observations: Observations,
) -> None:
    """From one measurement to the next it moves twice as fast, and each of the next ones says so."""
    hurried_s = np.where(
        observations.time_s < 6.0, observations.time_s, 6.0 + (observations.time_s - 6.0) / 2.0
    )
    ratios = []
    for time_s in (observations.time_s, hurried_s):
        window = followed(replace(observations, time_s=time_s).select(time_s < 6.4))
        at_s = float(time_s[time_s < 6.4][-1]) + AHEAD_S
        _, covariance = window.predict(at_s)
        ratios.append(float(np.trace(covariance[0]) / np.trace(without_surprise(window, at_s)[0])))
    assert ratios[0] == pytest.approx(1.0)
    assert ratios[1] > 2.0


def test_an_outlier_leaves_predictions_as_they_are(observations: Observations) -> None:
    """It says nothing of how the robot moves, however far off it is."""
    row = len(observations) - 3
    for off_m in (0.3, 30.0):
        points = observations.points_m.copy()
        points[row] *= 1 + off_m / np.linalg.norm(points[row])
        window = followed(replace(observations, points_m=points))
        at_s = float(observations.time_s[-1]) + AHEAD_S
        np.testing.assert_allclose(window.predict(at_s)[1], without_surprise(window, at_s), rtol=1e-6)


def test_the_hardest_manoeuvres_are_not_far_beyond_what_predictions_state() -> None:
    """They begin right after the last measurements, and nothing tells of them before the next ones."""
    motion = speeding_up_and_turning_back(
        duration_s=10.0, at_s=8.0, speeds_mps=(0.5, 1.5), rates_radps=(-0.5, 0.5)
    )
    largest = []
    for seed in range(6):
        measured = sorted_by_time(measure(motion, until_s=9.0, seed=seed))
        found = []
        for last_s in np.arange(7.6, 8.4, 0.1):
            window = followed(measured.select(measured.time_s < last_s))
            for ahead_s in np.arange(0.2, LATEST_S, 0.1):
                at = np.array([last_s + ahead_s])
                state, covariance = window.predict(float(at[0]), dim=6)
                error = state.local_coordinates_about(motion.select(rows_at(at)))[0, :6]
                found.append(float(error @ np.linalg.solve(covariance[0], error)))
        largest.append(max(found))
    # Squared errors in sigmas. By the prior alone, which knows no such robot, the mean of these is 40.
    assert np.mean(largest) < 36.0
