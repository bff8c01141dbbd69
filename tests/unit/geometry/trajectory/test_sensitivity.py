"""Consistency of absolute poses whose set-up is as wrong as its covariance says."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.prior_motion import draw_motions, measure, rows_at, sorted_by_time
from scipy.stats import chi2

from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.motion_calibration import Setup, SetupParameters, SetupPrior
from tsgt.geometry.trajectory import FixedLagSmoother, solve
from tsgt.geometry.trajectory.sensitivity import common_covariance, coupling, sensitivity
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations, SetupJacobian

ROBOTS = 24
AT_S = np.array([5.0])
UNCERTAIN = SetupPrior(translation_sigma_m=0.003, rotation_sigma_rad=1e-4, latency_sigma_s=1e-3)


def _by_setup(
    parameters: SetupParameters,
    setup: Setup,
    factor: FloatArray,
    observations: Observations,
    linearised: LinearisedMeasurements,
) -> FloatArray:
    by_setup: FloatArray = parameters.jacobian(observations, linearised, setup) @ factor
    return by_setup


@pytest.fixture(scope="module")
def nees() -> tuple[float, float]:
    """Mean NEES of poses with the full covariance, and with its random part alone."""
    prior, rng = MotionPrior(), np.random.default_rng(5)
    full, random = [], []
    for number, motion in enumerate(draw_motions(prior, count=ROBOTS, duration_s=10.5, seed=7)):
        observations = sorted_by_time(measure(motion, until_s=10.0, seed=number))
        parameters = SetupParameters.of_observations(observations, Setup.of(observations))
        factor = UNCERTAIN.factor(parameters)
        wrong = parameters.retract(parameters.reference, factor @ rng.normal(size=factor.shape[1]))
        trajectory = fit_trajectory(
            wrong.applied(observations),
            prior=prior,
            noise_scale=1.0,
            rest=(),
            setup_jacobian=partial(_by_setup, parameters, wrong, factor),
        ).trajectory
        states, covariance = trajectory.at(AT_S, dim=6)
        common = trajectory.common_at(AT_S, dim=6)
        assert common is not None
        error = motion.select(rows_at(AT_S)).local_coordinates_about(states)[0, :6]
        full.append(error @ np.linalg.solve(covariance[0] + common[0], error))
        random.append(error @ np.linalg.solve(covariance[0], error))
    return float(np.mean(full)), float(np.mean(random))


def test_absolute_poses_are_consistent(nees: tuple[float, float]) -> None:
    """The mean NEES of position and rotation lies in its 99 % band with the common part."""
    low, high = (float(chi2.ppf(share, 6 * ROBOTS)) / ROBOTS for share in (0.005, 0.995))
    assert low < nees[0] < high


def test_random_part_alone_is_too_certain(nees: tuple[float, float]) -> None:
    """Without the common part an absolute pose is outside of its band."""
    assert nees[1] > 1.5 * float(chi2.ppf(0.995, 6 * ROBOTS)) / ROBOTS


def test_newest_measurement_of_a_window_displaces_its_newest_state() -> None:
    """One measurement at a time, a window has the common covariance of a solution of all of them at once."""
    slow = MotionPrior(
        acceleration_sigma_mps2=(0.05, 0.05, 0.05), angular_acceleration_sigma_radps2=(0.02, 0.02, 0.02)
    )
    (motion,) = draw_motions(slow, count=1, duration_s=6.5, seed=7)
    observations = sorted_by_time(measure(motion, until_s=6.0, seed=0))
    parameters = SetupParameters.of_observations(observations, Setup.of(observations))
    by_setup = partial(_by_setup, parameters, Setup.of(observations), UNCERTAIN.factor(parameters))
    # A motion that the prior expects less than others: the newest measurement says much, and one step often suffices.
    prior, count = MotionPrior(), len(observations)
    smoother = FixedLagSmoother(prior, by_setup)
    smoother.update(observations.select(slice(count - 12)))
    for row in range(count - 12, count):
        smoother.update(observations.select(slice(row, row + 1)))
        found = smoother.common_at(float(observations.time_s[row]), dim=6)
        assert found is not None
        expected = _common_of_newest(observations.select(slice(row + 1)), smoother, by_setup)
        scale = np.outer(*2 * [np.sqrt(np.diagonal(expected))])
        np.testing.assert_allclose(found[0] / scale, expected / scale, atol=0.02)


def _common_of_newest(
    observations: Observations, smoother: FixedLagSmoother, by_setup: SetupJacobian
) -> FloatArray:
    solved = solve(observations, smoother.trajectory().knots, MotionPrior())
    mixed = coupling(
        observations,
        solved.linearised,
        solved.weights,
        solved.knot_index,
        len(solved.knots),
        by_setup(observations, solved.linearised),
    )
    return common_covariance(sensitivity(solved.factor, mixed))[0][-1, :6, :6]
