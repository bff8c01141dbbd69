"""Rotations, rigid transforms and SO(3) Jacobians against scipy, numerical derivatives, and at singular angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from tsgt.errors import GeometryError
from tsgt.geometry import (
    exp_so3,
    invert,
    log_so3,
    quaternion_from_rotation,
    rotate,
    rotation_from_quaternion,
    skew,
    transform_from,
    transform_points,
)
from tsgt.geometry.rigid import cross, exp_and_right_jacobian, fast_log_so3, inverse_right_jacobian, matvec

RANDOM = Rotation.random(500, random_state=1)
ANGLES_RAD = [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12, np.pi]
AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (-2 / 3, 1 / 3, 2 / 3)]

JACOBIAN_AXES = [(1.0, 0.0, 0.0), (0.6, 0.0, -0.8), (-2 / 3, 1 / 3, 2 / 3)]
JACOBIAN_ANGLES_RAD = [0.0, 1e-300, 1e-12, 1e-6, 9.9e-3, 1.01e-2, 0.3, 2.0, 3.1]
STEP = 1e-5

turns = arrays(np.float64, (3,), elements=st.floats(-1.8, 1.8))


def test_skew_is_the_cross_product() -> None:
    """skew(v) @ p equals the cross product of v and p."""
    v, p = np.random.default_rng(2).normal(size=(2, 50, 3))
    np.testing.assert_allclose((skew(v) @ p[:, :, None])[:, :, 0], np.cross(v, p), atol=1e-14)


def test_exp_agrees_with_scipy() -> None:
    """exp_so3 gives the matrix that scipy gives for the same rotation vector."""
    np.testing.assert_allclose(exp_so3(RANDOM.as_rotvec()), RANDOM.as_matrix(), atol=1e-14)


def test_log_agrees_with_scipy() -> None:
    """log_so3 gives the rotation vector that scipy gives for the same matrix."""
    np.testing.assert_allclose(log_so3(RANDOM.as_matrix()), RANDOM.as_rotvec(), atol=1e-13)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_exp_and_log_at_singular_angles(axis: tuple[float, float, float], angle_rad: float) -> None:
    """From zero to half a revolution, exp agrees with scipy and log inverts it, at pi up to its sign."""
    w = angle_rad * np.array(axis)
    R = exp_so3(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-15)
    found = log_so3(R)
    if angle_rad == np.pi:
        found *= np.sign(found @ w)
    np.testing.assert_allclose(found, w, rtol=0, atol=1e-13 * angle_rad)


def test_log_keeps_small_rotations_to_full_precision() -> None:
    """A rotation of 1e-8 rad survives exp and log with a relative error of rounding."""
    w = np.array([3e-9, -5e-9, 8e-9])
    np.testing.assert_allclose(log_so3(exp_so3(w)), w, rtol=1e-14)


def test_quaternion_agrees_with_scipy() -> None:
    """Quaternions are scipy's (x, y, z, w), with w positive."""
    np.testing.assert_allclose(
        quaternion_from_rotation(RANDOM.as_matrix()), RANDOM.as_quat(canonical=True), atol=1e-15
    )


@pytest.mark.parametrize("axis", AXES)
def test_quaternion_at_pi(axis: tuple[float, float, float]) -> None:
    """At an angle of pi the quaternion is the axis, with w = 0."""
    R = 2 * np.outer(axis, axis) - np.eye(3)
    q = quaternion_from_rotation(R)
    assert abs(q[3]) < 1e-15
    np.testing.assert_allclose(q[:3] * np.sign(q[:3] @ axis), axis, atol=1e-15)


def test_rotation_of_quaternion_agrees_with_scipy() -> None:
    """A quaternion of any length gives scipy's rotation."""
    np.testing.assert_allclose(rotation_from_quaternion(3 * RANDOM.as_quat()), RANDOM.as_matrix(), atol=1e-15)


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (0, np.nan, 0, 1)])
def test_zero_or_nan_quaternion_is_rejected(q: tuple[float, ...]) -> None:
    """A zero or NaN quaternion raises an error."""
    with pytest.raises(GeometryError, match="quaternion"):
        rotation_from_quaternion(np.array(q))


def test_transform_points_is_rotation_then_translation() -> None:
    """One transform of many points equals its homogeneous matrix product."""
    rng = np.random.default_rng(3)
    T = transform_from(RANDOM[0].as_matrix(), rng.normal(size=3))
    points = rng.normal(size=(20, 3))
    homogeneous = np.column_stack([points, np.ones(20)]) @ T.T
    np.testing.assert_allclose(transform_points(T, points), homogeneous[:, :3], atol=1e-14)


def test_transform_points_one_to_one() -> None:
    """N transforms are paired with N points."""
    T = transform_from(RANDOM[:5].as_matrix(), np.arange(15.0).reshape(5, 3))
    points = np.ones((5, 3))
    expected = [transform_points(T[i], points[i]) for i in range(5)]
    np.testing.assert_array_equal(transform_points(T, points), expected)


def test_invert_equals_matrix_inverse() -> None:
    """The inverse of each transform is that of its matrix."""
    T = transform_from(RANDOM.as_matrix(), np.random.default_rng(4).normal(size=(500, 3)))
    np.testing.assert_allclose(invert(T), np.linalg.inv(T), atol=1e-13)


def right_jacobian(turn: np.ndarray) -> np.ndarray:
    """Right Jacobian alone."""
    return exp_and_right_jacobian(turn)[1]


@pytest.mark.parametrize("angle_rad", JACOBIAN_ANGLES_RAD)
def test_exp_with_jacobian_agrees_with_exp(angle_rad: float) -> None:
    """Both functions give the same rotation matrix."""
    turn = angle_rad * np.array(JACOBIAN_AXES)
    np.testing.assert_allclose(exp_and_right_jacobian(turn)[0], exp_so3(turn), atol=1e-15)


@pytest.mark.parametrize("axis", JACOBIAN_AXES)
@pytest.mark.parametrize("angle_rad", JACOBIAN_ANGLES_RAD)
def test_right_jacobian_is_the_derivative_of_exp(axis: tuple[float, float, float], angle_rad: float) -> None:
    """Exp(w)^T Exp(w + d) rotates by J_r d to first order."""
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
def test_inverse_right_jacobian_inverts_right_jacobian(turn: np.ndarray) -> None:
    """Their product is the identity below pi."""
    assume(np.linalg.norm(turn) < 3.1)
    np.testing.assert_allclose(right_jacobian(turn) @ inverse_right_jacobian(turn), np.eye(3), atol=1e-12)


@settings(derandomize=True)
@given(turns)
def test_left_jacobian_is_right_jacobian_of_the_negative(turn: np.ndarray) -> None:
    """J_l(w) = J_r(-w) = Exp(w) J_r(w)."""
    np.testing.assert_allclose(right_jacobian(-turn), exp_so3(turn) @ right_jacobian(turn), atol=1e-12)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-300, 1e-160, 1e-12, 1e-9, 3e-8, 1e-6, 1e-4])
def test_jacobians_of_small_rotations_keep_precision(angle_rad: float) -> None:
    """Both Jacobians equal their series to rounding."""
    turn = angle_rad * np.array([2 / 3, -1 / 3, 2 / 3])
    across = skew(turn)
    series = np.eye(3) - across / 2 + across @ across / 6 - across @ across @ across / 24
    inverse = np.eye(3) + across / 2 + across @ across / 12
    np.testing.assert_allclose(right_jacobian(turn), series, rtol=0, atol=4e-16)
    np.testing.assert_allclose(inverse_right_jacobian(turn), inverse, rtol=0, atol=4e-16)


@pytest.mark.parametrize("largest_rad", [1e-12, 1e-3, 0.9, 3.0])
def test_fast_log_agrees_with_log(largest_rad: float) -> None:
    """For small rotations and for those beyond a right angle."""
    rng = np.random.default_rng(2)
    turns = rng.normal(size=(50, 3))
    turns *= largest_rad * rng.uniform(size=(50, 1)) / np.linalg.norm(turns, axis=1, keepdims=True)
    np.testing.assert_allclose(fast_log_so3(exp_so3(turns)), turns, rtol=1e-9, atol=1e-15)


def test_cross_agrees_with_numpy() -> None:
    """One vector with many, and many with many."""
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 20, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-15)
    np.testing.assert_allclose(cross(a, b[0]), np.cross(a, b[0]), atol=1e-15)


def test_matvec_agrees_with_rotate() -> None:
    """One matrix per vector, and one for all vectors."""
    turns = np.random.default_rng(1).normal(size=(5, 3))
    rotations = exp_so3(turns)
    np.testing.assert_allclose(matvec(rotations, turns), rotate(rotations, turns), atol=1e-15)
    np.testing.assert_allclose(matvec(rotations[0], turns), rotate(rotations[0], turns), atol=1e-15)
