"""Roll, pitch and yaw: R = Rz(yaw) Ry(pitch) Rx(roll), rotations about the axes of the world in the order x, y, z."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray

_MIN_COS_PITCH = 1e-2  # closer to 90 degrees of pitch, roll and yaw cannot be told apart


def euler_angles_rad(R: FloatArray) -> FloatArray:
    """Return roll, pitch and yaw of rotations, (..., 3)."""
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    # The arcsine of one element would be ill-conditioned near 90 degrees.
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 2, 1], R[..., 2, 2]))
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return np.stack([roll, pitch, yaw], axis=-1)


def euler_jacobian(R: FloatArray) -> FloatArray:
    """Return, (..., 3, 3), the change of roll, pitch and yaw by a small rotation about the axes of the world.

    NaN near 90 degrees of pitch. Source: Diebel 2006, Representing attitude, section 5.5 (the matrix E' of the sequence 1-2-3).
    """
    x_axis = R[..., :, 0]  # the axis of roll: x of the robot
    cos_pitch = np.hypot(R[..., 2, 1], R[..., 2, 2])
    safe = np.where(cos_pitch > _MIN_COS_PITCH, cos_pitch, np.nan)
    # With u the horizontal direction of the robot's x axis and v the axis of pitch, across it:
    # rotation = roll (cos p u - sin p z) + pitch v + yaw z
    u = np.stack([x_axis[..., 0], x_axis[..., 1], np.zeros_like(safe)], axis=-1) / safe[..., None]
    v = np.stack([-u[..., 1], u[..., 0], np.zeros_like(safe)], axis=-1)
    z = np.broadcast_to([0.0, 0.0, 1.0], u.shape)
    sin_pitch = -x_axis[..., 2]
    return np.stack([u / safe[..., None], v, z + u * (sin_pitch / safe)[..., None]], axis=-2)


def euler_covariance(R: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance of roll, pitch and yaw, (..., 3, 3), from that of a small rotation about the axes of the world."""
    J = euler_jacobian(R)
    return np.asarray(J @ covariance @ np.swapaxes(J, -1, -2))
