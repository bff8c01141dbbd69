"""Process noise that follows the motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from harness.drives.prior_motion import draw_motions, measure, rows_at, sorted_by_time
from harness.drives.slow_motion import measure_along

from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

PRIOR = MotionPrior()


def with_one_swerve(time_s: FloatArray) -> FloatArray:
    """Drive at 1 m/s, with a jolt of 20 cm within a second at 15 s."""
    return time_s + 0.2 / (1.0 + np.exp(-8.0 * (time_s - 15.0)))


def test_noise_is_large_where_the_robot_manoeuvres_and_small_elsewhere() -> None:
    """By factors of one and a half; sideways, and rotations, stay calm."""
    observations = measure_along(with_one_swerve, until_s=30.0, seed=1)
    found = fit_trajectory(observations, prior=PRIOR, noise_scale=1.0)
    assert found.trajectory.sigmas is not None
    ratio = found.trajectory.sigmas / axis_sigmas(PRIOR)
    middle_s = 0.5 * (found.trajectory.knots.time_s[1:] + found.trajectory.knots.time_s[:-1])
    at_swerve = np.abs(middle_s - 15.0) < 0.3
    steady = (middle_s > 3.0) & (np.abs(middle_s - 15.0) > 3.0) & (middle_s < 27.0)
    assert ratio[at_swerve, 0].min() > 1.5
    assert ratio[steady, 0].max() < 0.65
    assert ratio[at_swerve, 3:].max() < 1.0


def test_noise_of_a_robot_that_moves_as_the_prior_says_is_kept() -> None:
    """On average, to a tenth, and the errors of its poses stay within their covariances."""
    ratios, nees = [], []
    at_s = np.arange(2.0, 18.0, 1.0)
    for number, motion in enumerate(draw_motions(PRIOR, count=8, duration_s=21.0, seed=2)):
        observations = sorted_by_time(measure(motion, until_s=20.0, seed=number))
        found = fit_trajectory(observations, prior=PRIOR, noise_scale=1.0)
        assert found.trajectory.sigmas is not None
        ratios.append(np.log(found.trajectory.sigmas / axis_sigmas(PRIOR)).mean())
        states, covariance = found.trajectory.at(at_s, dim=6)
        error = motion.select(rows_at(at_s)).local_coordinates_about(states)[:, :6]
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))
    assert abs(np.mean(ratios)) < 0.1
    assert 5.0 < np.mean(nees) < 7.0


def test_noise_is_kept_where_prisms_are_hidden() -> None:
    """There the measurements do not tell the motion: a calm drive before says nothing about it."""
    observations = measure_along(lambda time_s: time_s, until_s=30.0, seed=3)
    hidden = (observations.time_s > 12.0) & (observations.time_s < 18.0) & (observations.prism != 0)
    found = fit_trajectory(observations.select(~hidden), prior=PRIOR, noise_scale=1.0)
    assert found.trajectory.sigmas is not None
    middle_s = 0.5 * (found.trajectory.knots.time_s[1:] + found.trajectory.knots.time_s[:-1])
    inside = (middle_s > 12.5) & (middle_s < 17.5)
    np.testing.assert_allclose(
        found.trajectory.sigmas[inside], np.repeat(axis_sigmas(PRIOR)[None], np.count_nonzero(inside), axis=0)
    )
    assert found.trajectory.sigmas[(middle_s > 5.0) & (middle_s < 10.0), 0].max() < 0.3
