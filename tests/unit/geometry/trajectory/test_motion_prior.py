"""Motion prior: transition and process noise against Van Loan's matrix exponential, limits, interpolation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from tsgt.geometry.trajectory.motion_prior import (
    axis_correlation_times_s,
    axis_sigmas,
    interpolation_weights,
    prior_from_axes,
    process_information,
    process_noise,
    transition,
)
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

# Short and long in correlation times, on both sides of where the formulas change.
STEPS_S = np.array([0.005, 0.02, 0.1, 0.4, 1.0, 3.0])
TIMES_S = np.array([0.08, 0.2, 0.4999, 0.5, 0.8, 2.0, 30.0, 1e4])


def van_loan(dt_s: float, time_s: float) -> tuple[FloatArray, FloatArray]:
    """Transition and process noise of an axis from one matrix exponential (C. Van Loan, IEEE TAC 23(3), 1978)."""
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / time_s]])
    kicks = np.diag([0.0, 0.0, 2.0 / time_s])
    whole = expm(np.block([[-A, kicks], [np.zeros((3, 3)), A.T]]) * dt_s)
    phi = whole[3:, 3:].T
    return phi, phi @ whole[:3, 3:]


@pytest.mark.parametrize("time_s", TIMES_S)
@pytest.mark.parametrize("dt_s", STEPS_S)
def test_transition_and_noise_agree_with_van_loan(dt_s: float, time_s: float) -> None:
    """Both equal the matrix exponential's to its precision."""
    phi, q = van_loan(dt_s, time_s)
    np.testing.assert_allclose(transition(dt_s, time_s), phi, rtol=1e-12, atol=1e-13)
    # The exponential grows with exp(dt / time), and its rounding with it.
    scale = np.sqrt(np.outer(np.diag(q), np.diag(q)))
    rounding = 1e-13 * np.exp(dt_s / time_s) * max(1.0, time_s / dt_s) ** 2
    np.testing.assert_allclose(process_noise(dt_s, time_s) / scale, q / scale, atol=1e-9 + rounding)


@settings(derandomize=True)
@given(st.floats(-3.0, 2.0), st.floats(-3.0, 4.0))
def test_steps_compose(log_dt: float, log_time: float) -> None:
    """Two equal steps equal one of twice the length."""
    dt_s, time_s = 10.0**log_dt, 10.0**log_time
    phi, q = transition(dt_s, time_s), process_noise(dt_s, time_s)
    np.testing.assert_allclose(phi @ phi, transition(2 * dt_s, time_s), rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(phi @ q @ phi.T + q, process_noise(2 * dt_s, time_s), rtol=1e-9)


@pytest.mark.parametrize("s", [1e-2, 2.0])
def test_formulas_are_continuous(s: float) -> None:
    """No jump where one formula takes over from another."""
    below, above = np.array([s * (1 - 1e-12), s * (1 + 1e-12)])
    np.testing.assert_allclose(transition(below, 1.0), transition(above, 1.0), rtol=1e-11)
    np.testing.assert_allclose(process_noise(below, 1.0), process_noise(above, 1.0), rtol=1e-10)


def test_short_correlation_is_white_noise_on_acceleration() -> None:
    """For a correlation time near zero the process noise is that of white acceleration."""
    dt_s, time_s = 0.4, 1e-5
    density = 2 * time_s
    expected = density * np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
    np.testing.assert_allclose(process_noise(dt_s, time_s)[:2, :2], expected, rtol=1e-3)
    np.testing.assert_allclose(transition(dt_s, time_s)[:2, :2], [[1.0, dt_s], [0.0, 1.0]])


def test_long_correlation_is_white_noise_on_jerk() -> None:
    """For a long correlation time the process noise is that of white jerk."""
    t, time_s = 0.4, 1e5
    expected = np.array(
        [[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]]
    )
    np.testing.assert_allclose(process_noise(t, time_s) * time_s / 2, expected, rtol=1e-4)
    np.testing.assert_allclose(
        transition(t, time_s), np.array([[1.0, t, t**2 / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]]), rtol=1e-5
    )


@settings(derandomize=True)
@given(st.floats(-2.3, 1.0), st.floats(-2.0, 4.0))
def test_information_is_the_inverse_of_the_noise(log_dt: float, log_time: float) -> None:
    """Their product is the identity at any scale."""
    dt_s, time_s = 10.0**log_dt, 10.0**log_time
    q = process_noise(dt_s, time_s)
    scale = np.sqrt(np.diag(q))
    product = (q / np.outer(scale, scale)) @ (process_information(dt_s, time_s) * np.outer(scale, scale))
    np.testing.assert_allclose(product, np.eye(3), atol=1e-7)


@pytest.mark.parametrize("time_s", [0.05, 0.4, 3.0, 100.0])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_interpolation_is_dense_conditioning(share: float, time_s: float) -> None:
    """Interpolation equals conditioning the joint Gaussian on both ends."""
    step_s = 0.4
    before_s, after_s = share * step_s, (1 - share) * step_s
    q_here, q_on = process_noise(before_s, time_s), process_noise(after_s, time_s)
    on = transition(after_s, time_s)
    q_later, cross = on @ q_here @ on.T + q_on, q_here @ on.T
    gain = np.linalg.solve(q_later, cross.T).T
    from_earlier, from_later, left = interpolation_weights(
        np.array(before_s), np.array(after_s), np.array(time_s)
    )
    np.testing.assert_allclose(from_later, gain, rtol=1e-6, atol=1e-7)
    expected = transition(before_s, time_s) - gain @ on @ transition(before_s, time_s)
    np.testing.assert_allclose(from_earlier, expected, rtol=1e-6, atol=1e-7)
    scale = np.sqrt(np.diag(q_here))
    np.testing.assert_allclose(
        left / np.outer(scale, scale), (q_here - gain @ cross.T) / np.outer(scale, scale), atol=1e-7
    )


def test_interpolation_at_the_ends() -> None:
    """At either end it is that end's state, with zero covariance."""
    zero, step = np.array(0.0), np.array(0.4)
    for before, after, earlier_share in ((zero, step, 1.0), (step, zero, 0.0)):
        from_earlier, from_later, left = interpolation_weights(before, after, np.array(0.5))
        np.testing.assert_allclose(from_earlier, earlier_share * np.eye(3), atol=1e-10)
        np.testing.assert_allclose(from_later, (1 - earlier_share) * np.eye(3), atol=1e-10)
        np.testing.assert_allclose(left, 0.0, atol=1e-12)


def test_prior_round_trip() -> None:
    """A prior made of sigmas and times returns them."""
    prior = MotionPrior()
    times_s = axis_correlation_times_s(prior)
    assert prior_from_axes(axis_sigmas(prior), times_s[[0, 5]]) == prior
