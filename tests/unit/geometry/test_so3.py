"""Derivatives of rotations against numerical ones, at every size of turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tsgt.geometry import exp_so3, log_so3, rotate, skew
from tsgt.geometry.rigid import cross, exp_and_right_jacobian, fast_log_so3, inverse_right_jacobian, matvec

AXES = [(1.0, 0.0, 0.0), (0.6, 0.0, -0.8), (-2 / 3, 1 / 3, 2 / 3)]
ANGLES_RAD = [0.0, 1e-300, 1e-12, 1e-6, 9.9e-3, 1.01e-2, 0.3, 2.0, 3.1]
STEP = 1e-5

turns = arrays(np.float64, (3,), elements=st.floats(-1.8, 1.8))


def right_jacobian(turn: np.ndarray) -> np.ndarray:
    """Give the second of both."""
    return exp_and_right_jacobian(turn)[1]


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_the_rotation_beside_the_derivative_is_that_of_exp(angle_rad: float) -> None:
    """Both ways to a rotation matrix agree."""
    turn = angle_rad * np.array(AXES)
    np.testing.assert_allclose(exp_and_right_jacobian(turn)[0], exp_so3(turn), atol=1e-15)


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


@pytest.mark.parametrize("angle_rad", [0.0, 1e-300, 1e-160, 1e-12, 1e-9, 3e-8, 1e-6, 1e-4])
def test_small_turns_lose_no_digits(angle_rad: float) -> None:
    """Both functions are their series to rounding, although the factor of the square alone is not."""
    turn = angle_rad * np.array([2 / 3, -1 / 3, 2 / 3])
    across = skew(turn)
    series = np.eye(3) - across / 2 + across @ across / 6 - across @ across @ across / 24
    inverse = np.eye(3) + across / 2 + across @ across / 12
    np.testing.assert_allclose(right_jacobian(turn), series, rtol=0, atol=4e-16)
    np.testing.assert_allclose(inverse_right_jacobian(turn), inverse, rtol=0, atol=4e-16)


@pytest.mark.parametrize("largest_rad", [1e-12, 1e-3, 0.9, 3.0])
def test_the_fast_logarithm_is_the_logarithm(largest_rad: float) -> None:
    """To the last digits, and for turns beyond a right angle as well."""
    rng = np.random.default_rng(2)
    turns = rng.normal(size=(50, 3))
    turns *= largest_rad * rng.uniform(size=(50, 1)) / np.linalg.norm(turns, axis=1, keepdims=True)
    np.testing.assert_allclose(fast_log_so3(exp_so3(turns)), turns, rtol=1e-9, atol=1e-15)


def test_the_fast_cross_product_is_the_cross_product() -> None:
    """One vector with many, and many with many."""
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 20, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-15)
    np.testing.assert_allclose(cross(a, b[0]), np.cross(a, b[0]), atol=1e-15)


def test_products_with_vectors_are_rotations() -> None:
    """Matrices that turn vectors, one for each, and one for all of them."""
    turns = np.random.default_rng(1).normal(size=(5, 3))
    rotations = exp_so3(turns)
    np.testing.assert_allclose(matvec(rotations, turns), rotate(rotations, turns), atol=1e-15)
    np.testing.assert_allclose(matvec(rotations[0], turns), rotate(rotations[0], turns), atol=1e-15)
