"""Process factors of a robot at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.prior_motion import CENTRE_M
from harness.drives.slow_motion import LINE_OF_SIGHT, braking, creeping, measure_along

from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.rest import RestInterval, in_rest, rest_factors, steps_in_rest, with_vibration
from tsgt.geometry.trajectory import initial_guess, knot_times, nearest_knots
from tsgt.geometry.trajectory.gauss_newton import assemble, diffuse_prior
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.geometry.trajectory.states import STATE_DIM, ProcessFactors
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

PRIOR = MotionPrior()
INTERVALS = [RestInterval(2.0, 5.0, 0.0), RestInterval(5.5, 7.0, 0.002)]


def test_times_are_in_their_interval() -> None:
    """The ends belong to it."""
    index = in_rest(INTERVALS, np.array([1.9, 2.0, 5.0, 5.2, 6.0, 7.1]))
    np.testing.assert_array_equal(index, [-1, 0, 0, -1, 1, -1])
    np.testing.assert_array_equal(in_rest([], np.zeros(2)), [-1, -1])


def test_step_between_two_intervals_is_moving() -> None:
    """Also when both of its knots are at rest."""
    np.testing.assert_array_equal(
        steps_in_rest(INTERVALS, np.array([4.0, 5.0, 5.5, 6.0])), [True, False, True]
    )


def test_vibration_is_noise() -> None:
    """At rest the noise is the stated one with the vibration, or more if it was scaled to more."""
    observations = measure_along(creeping(0.0), until_s=8.0, seed=1)
    stated_m = observations.sigmas_m / 1.5
    found = with_vibration(observations, INTERVALS, stated_m).sigmas_m
    vibrating = (observations.time_s >= 5.5) & (observations.time_s <= 7.0)
    np.testing.assert_array_equal(found[~vibrating], observations.sigmas_m[~vibrating])
    expected = np.maximum(observations.sigmas_m, np.hypot(stated_m, 0.002))
    np.testing.assert_allclose(found[vibrating], expected[vibrating])


def test_gradient_is_that_of_the_cost() -> None:
    """By numerical differentiation, with the second derivatives of the normal equations."""
    observations = measure_along(creeping(0.0), until_s=3.5, seed=2)
    times_s = knot_times(observations.time_s)
    knots = initial_guess(observations, times_s)
    sigmas = np.repeat(axis_sigmas(PRIOR)[None], len(times_s) - 1, axis=0)
    sigmas, rest = rest_factors([RestInterval(1.0, 3.0, 0.0)], times_s, sigmas, observations.layout)
    process = ProcessFactors.of(times_s, PRIOR, sigmas, rest)
    arguments = process, diffuse_prior(knots.select(slice(0, 1)), PRIOR)
    index = nearest_knots(times_s, observations.time_s)
    moving = assemble(observations, index, knots, ProcessFactors.of(times_s, PRIOR, sigmas), arguments[1])
    at_rest = assemble(observations, index, knots, *arguments)
    direction = np.random.default_rng(3).normal(size=(len(knots), STATE_DIM))
    direction[:, [0, 1, 2, 3, 4, 5, *range(12, 18)]] = 0.0
    step = 1e-4

    def excess(size: float) -> float:
        moved = knots.retract(size * direction)
        without = ProcessFactors.of(times_s, PRIOR, sigmas)
        return (
            assemble(observations, index, moved, *arguments).cost
            - assemble(observations, index, moved, without, arguments[1]).cost
        )

    slope = (excess(step) - excess(-step)) / (2 * step)
    assert slope == pytest.approx(2 * np.vdot(at_rest.gradient - moving.gradient, direction), rel=1e-5)
    curvature = (excess(step) - 2 * excess(0.0) + excess(-step)) / step**2
    information = np.einsum("ki,kij,kj->", direction, at_rest.diagonal - moving.diagonal, direction)
    assert curvature == pytest.approx(2 * information, rel=1e-4)


def test_poses_at_rest_are_means() -> None:
    """Errors are several times smaller than while moving, and the covariance says so."""
    errors, sigmas = [], []
    for seed in range(8):
        observations = measure_along(braking(0.5, 4.0, 2.0), until_s=14.0, seed=seed)
        found = fit_trajectory(observations, prior=PRIOR, noise_scale=1.0)
        at_s = np.array([2.0, 10.0])
        states, covariance = found.trajectory.at(at_s, dim=6)
        truth = CENTRE_M + np.append(LINE_OF_SIGHT, 0.0) * braking(0.5, 4.0, 2.0)(at_s)[:, None]
        errors.append(np.linalg.norm(states.position - truth, axis=1))
        sigmas.append(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2)))
    moving, at_rest = np.sqrt(np.mean(np.square(errors), axis=0))
    assert at_rest < 0.6 * moving
    assert at_rest == pytest.approx(np.mean(sigmas, axis=0)[1], rel=0.4)


def test_wander_is_followed() -> None:
    """A robot that sinks by 0.3 mm/s is at rest, and its poses follow it to a millimetre."""
    observations = measure_along(creeping(3e-4), until_s=40.0, seed=4)
    found = fit_trajectory(observations, prior=PRIOR, noise_scale=1.0)
    assert sum(each.end_s - each.start_s for each in found.rest) > 30.0
    at_s = np.linspace(3.0, 37.0, 50)
    states, _ = found.trajectory.at(at_s, dim=6)
    along = (states.position - CENTRE_M)[:, :2] @ LINE_OF_SIGHT - 3e-4 * at_s
    assert np.sqrt(np.mean(along**2)) < 1e-3


def test_rocking_is_within_the_covariance() -> None:
    """A robot that rocks by two millimetres looks like one that vibrates: its poses say how far off the mean it may be."""

    def rocking(time_s: FloatArray) -> FloatArray:
        return 2e-3 * np.sin(2 * np.pi * time_s)

    at_s = np.linspace(3.0, 37.0, 69)
    found = fit_trajectory(measure_along(rocking, until_s=40.0, seed=5), prior=PRIOR, noise_scale=1.0)
    states, covariance = found.trajectory.at(at_s, dim=6)
    error = states.position - CENTRE_M
    error[:, :2] -= rocking(at_s)[:, None] * LINE_OF_SIGHT
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance[:, :3, :3]), error)
    assert found.rest_s > 30.0
    assert nees.mean() < 5.0
