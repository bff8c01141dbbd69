"""Rotations and transforms against scipy's Rotation, and at the angles where formulas break."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.errors import GeometryError
from tsgt.geometry import (
    check_transform,
    exp_so3,
    invert,
    log_so3,
    quaternion_from_rotation,
    rotation_from_quaternion,
    skew,
    transform_from,
    transform_points,
)

RANDOM = Rotation.random(500, random_state=1)
ANGLES_RAD = [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12, np.pi]
AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (-2 / 3, 1 / 3, 2 / 3)]


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
    """From no rotation to half a turn, exp agrees with scipy and log finds the vector back, at pi up to its sign."""
    w = angle_rad * np.array(axis)
    R = exp_so3(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-15)
    found = log_so3(R)
    if angle_rad == np.pi:
        found *= np.sign(found @ w)
    np.testing.assert_allclose(found, w, rtol=0, atol=1e-13 * angle_rad)


def test_log_keeps_small_rotations_to_full_precision() -> None:
    """A rotation of 1e-8 rad comes back with a relative error of rounding, where the trace would have lost it."""
    w = np.array([3e-9, -5e-9, 8e-9])
    np.testing.assert_allclose(log_so3(exp_so3(w)), w, rtol=1e-14)


def test_quaternion_agrees_with_scipy() -> None:
    """Quaternions are scipy's (x, y, z, w), with the sign that makes w positive."""
    np.testing.assert_allclose(
        quaternion_from_rotation(RANDOM.as_matrix()), RANDOM.as_quat(canonical=True), atol=1e-15
    )


@pytest.mark.parametrize("axis", AXES)
def test_quaternion_of_half_a_turn(axis: tuple[float, float, float]) -> None:
    """At half a turn the quaternion is the axis, with w = 0."""
    R = 2 * np.outer(axis, axis) - np.eye(3)
    q = quaternion_from_rotation(R)
    assert abs(q[3]) < 1e-15
    np.testing.assert_allclose(q[:3] * np.sign(q[:3] @ axis), axis, atol=1e-15)


def test_rotation_of_quaternion_agrees_with_scipy() -> None:
    """A quaternion of any length gives the rotation that scipy gives."""
    np.testing.assert_allclose(rotation_from_quaternion(3 * RANDOM.as_quat()), RANDOM.as_matrix(), atol=1e-15)


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (0, np.nan, 0, 1)])
def test_quaternion_without_direction_is_refused(q: tuple[float, ...]) -> None:
    """A zero or NaN quaternion is an error, not a matrix of NaN."""
    with pytest.raises(GeometryError, match="quaternion"):
        rotation_from_quaternion(np.array(q))


def test_transform_points_is_rotation_then_translation() -> None:
    """One transform moves many points as its matrix does in homogeneous coordinates."""
    rng = np.random.default_rng(3)
    T = transform_from(RANDOM[0].as_matrix(), rng.normal(size=3))
    points = rng.normal(size=(20, 3))
    homogeneous = np.column_stack([points, np.ones(20)]) @ T.T
    np.testing.assert_allclose(transform_points(T, points), homogeneous[:, :3], atol=1e-14)


def test_transform_points_one_to_one() -> None:
    """N transforms with N points pair up."""
    T = transform_from(RANDOM[:5].as_matrix(), np.arange(15.0).reshape(5, 3))
    points = np.ones((5, 3))
    expected = [transform_points(T[i], points[i]) for i in range(5)]
    np.testing.assert_array_equal(transform_points(T, points), expected)


def test_invert_undoes_a_transform() -> None:
    """The inverse of each of many transforms is that of its matrix."""
    T = transform_from(RANDOM.as_matrix(), np.random.default_rng(4).normal(size=(500, 3)))
    np.testing.assert_allclose(invert(T), np.linalg.inv(T), atol=1e-13)


def test_check_transform_accepts_six_decimals() -> None:
    """A transform that somebody typed with six decimals is rigid enough."""
    check_transform(np.round(transform_from(RANDOM[7].as_matrix(), np.array([1.0, 2.0, 3.0])), 6))


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.eye(3), "4x4 numbers, got 3x3"),
        (np.diag([1, 1, np.nan, 1]), "finite"),
        (np.diag([1, 1, 1, 2]), "last row"),
        (np.diag([1, 1, 1.001, 1]), "orthonormal"),
        (np.diag([1, 1, -1, 1]), "mirrors"),
    ],
)
def test_check_transform_says_what_is_wrong(T: np.ndarray, message: str) -> None:
    """Wrong shape, NaN, a wrong last row, a scaled axis and a mirrored axis are each named."""
    with pytest.raises(GeometryError, match=message):
        check_transform(T)
