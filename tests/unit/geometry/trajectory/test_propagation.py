"""Propagation of one state: equal to a trajectory's extrapolation, to rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tsgt.geometry import FloatArray, exp_so3
from tsgt.geometry.trajectory import STATE_DIM, States, Trajectory
from tsgt.geometry.trajectory.propagation import Propagator
from tsgt.model import MotionPrior

PRIOR = MotionPrior(acceleration_correlation_time_s=0.3, angular_acceleration_correlation_time_s=0.9)


def rotating(rate_radps: float) -> tuple[States, FloatArray]:
    """Draw a random state with a given angular velocity, and its covariance."""
    rng = np.random.default_rng(4)
    parts = rng.normal(size=(5, 1, 3))
    parts[[2, 4]] *= rate_radps
    place, speed, rate, slow, turn = parts
    spread = rng.normal(size=(STATE_DIM, STATE_DIM))
    rotation = exp_so3(rng.normal(size=(1, 3)))
    return States(np.array([7.0]), 30 * place, rotation, speed, rate, slow, turn), 1e-3 * spread @ spread.T


@pytest.mark.parametrize("rate_radps", [0.0, 1e-3, 0.3, 5.0])
@pytest.mark.parametrize("ahead_s", [0.0, 1e-9, 1e-3, 0.05, 0.4, 0.7, 3.0, 30.0])
def test_propagation_agrees_with_trajectory(rate_radps: float, ahead_s: float) -> None:
    """State and covariance, whole and of the pose alone, on both sides of the series' limits."""
    state, covariance = rotating(rate_radps)
    whole = Trajectory(state, PRIOR, covariance[None], np.empty((0, STATE_DIM, STATE_DIM)))
    time_s = 7.0 + ahead_s
    for dim in (6, STATE_DIM):
        found, spread = Propagator(state, covariance, PRIOR).at(time_s, dim=dim)
        expected, expected_spread = whole.at(np.array([time_s]), dim=dim)
        for name in States.__slots__:
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-12)
        sigmas = np.sqrt(np.diagonal(expected_spread[0]))
        scale = sigmas[:, None] * sigmas
        np.testing.assert_allclose(spread / scale, expected_spread / scale, rtol=0, atol=1e-12)


def test_process_noise_scale_acts_on_the_variance() -> None:
    """A scale of two equals a prior with twice the variance of the accelerations."""
    state, covariance = rotating(0.3)
    sigma_mps2, sigma_radps2 = PRIOR.acceleration_sigma_mps2, PRIOR.angular_acceleration_sigma_radps2
    x, y, z, roll, pitch, yaw = (float(np.sqrt(2.0)) * each for each in (*sigma_mps2, *sigma_radps2))
    doubled_prior = replace(
        PRIOR, acceleration_sigma_mps2=(x, y, z), angular_acceleration_sigma_radps2=(roll, pitch, yaw)
    )
    _, found = Propagator(state, covariance, PRIOR, process_noise_scale=2.0).at(7.6)
    _, expected = Propagator(state, covariance, doubled_prior).at(7.6)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_memory_does_not_grow_with_time() -> None:
    """Without measurements, the poses of hours are predicted from one state."""
    propagator = Propagator(*rotating(0.3), PRIOR)
    for step in range(100):
        propagator.at(7.0 + 0.05 * step)
    assert len(propagator._found) <= 16
