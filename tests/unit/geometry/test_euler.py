from __future__ import annotations

import numpy as np
import pytest

from tsgt.geometry import (
    euler_angles_rad,
    euler_covariance,
    euler_jacobian,
    exp_so3,
    rotation_from_quaternion,
)


@pytest.mark.parametrize("angles_rad", [(0.1, -0.2, 0.3), (3.0, 1.5, -3.1), (-1.0, -1.57, 0.5)])
def test_euler_angles_are_about_fixed_axes_x_y_z(angles_rad: tuple[float, float, float]) -> None:
    """The inverse of R = Rz Ry Rx."""
    x, y, z = (exp_so3(angle * axis) for angle, axis in zip(angles_rad, np.eye(3), strict=True))
    np.testing.assert_allclose(euler_angles_rad(z @ y @ x), angles_rad, atol=1e-9)


def test_euler_angles_of_many_rotations_at_once() -> None:
    """Leading dimensions are kept."""
    rotations = rotation_from_quaternion(np.random.default_rng(0).standard_normal((4, 5, 4)))
    assert euler_angles_rad(rotations).shape == (4, 5, 3)
    assert euler_jacobian(rotations).shape == (4, 5, 3, 3)


def test_jacobian_agrees_with_small_rotations() -> None:
    """Numerically, by rotating about each axis of the world to both sides."""
    rotations = rotation_from_quaternion(np.random.default_rng(1).standard_normal((20, 4)))
    step = 1e-6
    columns = [
        (
            euler_angles_rad(exp_so3(step * axis) @ rotations)
            - euler_angles_rad(exp_so3(-step * axis) @ rotations)
        )
        / (2 * step)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(euler_jacobian(rotations), np.stack(columns, axis=-1), rtol=1e-6, atol=1e-6)


def test_roll_and_yaw_are_unknown_when_looking_up() -> None:
    """Only their sum has a meaning there."""
    up = exp_so3(np.array([0.0, -np.pi / 2, 0.0]))
    assert np.isnan(euler_covariance(up, np.eye(3))).any()
    np.testing.assert_allclose(
        euler_covariance(np.eye(3), np.diag([1.0, 4.0, 9.0])), np.diag([1.0, 4.0, 9.0])
    )
