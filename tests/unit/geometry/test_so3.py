"""Derivatives of rotations against numerical ones, at every size of turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tsgt.geometry import exp_so3, log_so3
from tsgt.geometry.so3 import cross, inverse_right_jacobian, log_of_steps, right_jacobian

AXES = [(1.0, 0.0, 0.0), (0.6, 0.0, -0.8), (-2 / 3, 1 / 3, 2 / 3)]
ANGLES_RAD = [0.0, 1e-300, 1e-12, 1e-6, 9.9e-3, 1.01e-2, 0.3, 2.0, 3.1]
STEP = 1e-5

turns = arrays(np.float64, (3,), elements=st.floats(-1.8, 1.8))


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_right_jacobian_is_the_derivative_of_exp(axis: tuple[float, float, float], angle_rad: float) -> None:
    """Exp(w)^T Exp(w + d) turns by J_r d to first order."""
    turn = angle_rad * np.array(axis)
    steps = STEP * np.eye(3)
    forth, back = (
        log_so3(exp_so3(turn).T @ exp_so3(turn + steps)),
        log_so3(exp_so3(turn).T @ exp_so3(turn - steps)),
    )
    numerical = (forth - back).T / (2 * STEP)
    np.testing.assert_allclose(right_jacobian(turn), numerical, atol=1e-9)


@settings(derandomize=True)
@given(turns)
def test_both_are_inverse(turn: np.ndarray) -> None:
    """The inverse right Jacobian is the inverse of the right Jacobian for turns below pi."""
    assume(np.linalg.norm(turn) < 3.1)
    np.testing.assert_allclose(right_jacobian(turn) @ inverse_right_jacobian(turn), np.eye(3), atol=1e-12)


@settings(derandomize=True)
@given(turns)
def test_left_jacobian_is_that_of_the_turn_back(turn: np.ndarray) -> None:
    """J_l(w) = J_r(-w) = Exp(w) J_r(w)."""
    np.testing.assert_allclose(right_jacobian(-turn), exp_so3(turn) @ right_jacobian(turn), atol=1e-12)


def test_nothing_jumps_where_the_series_ends() -> None:
    """On both sides of the angle at which the series takes over both functions agree."""
    axis = np.array([2 / 3, -1 / 3, 2 / 3])
    for function in (right_jacobian, inverse_right_jacobian):
        np.testing.assert_allclose(
            function((1e-2 - 1e-13) * axis), function((1e-2 + 1e-13) * axis), atol=1e-12
        )


@pytest.mark.parametrize("largest_rad", [1e-12, 1e-3, 0.9, 3.0])
def test_the_fast_logarithm_is_the_logarithm(largest_rad: float) -> None:
    """To the last digits, and for turns beyond a right angle as well."""
    rng = np.random.default_rng(2)
    turns = rng.normal(size=(50, 3))
    turns *= largest_rad * rng.uniform(size=(50, 1)) / np.linalg.norm(turns, axis=1, keepdims=True)
    np.testing.assert_allclose(log_of_steps(exp_so3(turns)), turns, rtol=1e-9, atol=1e-15)


def test_the_fast_cross_product_is_the_cross_product() -> None:
    """One vector with many, and many with many."""
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 20, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-15)
    np.testing.assert_allclose(cross(a, b[0]), np.cross(a, b[0]), atol=1e-15)
