"""Derivatives of rotations.

G. S. Chirikjian, "Stochastic models, information theory, and Lie groups", volume 2, section 10.8; T. D. Barfoot, "State
estimation for robotics", section 7.1.
"""

from __future__ import annotations

import numpy as np

from tsgt.geometry.rigid import FloatArray, dot, log_so3, skew

_SMALL_RAD = 1e-2
_WELL_BELOW_A_RIGHT_ANGLE = 0.5


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of vectors along the last axis, (..., 3); numpy's own takes five times as long for a few."""
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    product[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    product[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    product[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def log_of_steps(R: FloatArray) -> FloatArray:
    """Rotation vectors of rotations that are mostly small, (..., 3); as :func:`~tsgt.geometry.rigid.log_so3`, but faster."""
    cosine = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
    if np.any(cosine < _WELL_BELOW_A_RIGHT_ANGLE):
        return log_so3(R)
    turned = np.empty(R.shape[:-1])
    turned[..., 0] = 0.5 * (R[..., 2, 1] - R[..., 1, 2])
    turned[..., 1] = 0.5 * (R[..., 0, 2] - R[..., 2, 0])
    turned[..., 2] = 0.5 * (R[..., 1, 0] - R[..., 0, 1])
    sine = np.sqrt(dot(turned, turned))
    small = sine < np.finfo(np.float64).tiny
    scale = np.where(small, 1.0, np.arctan2(sine, cosine) / np.where(small, 1.0, sine))
    logarithm: FloatArray = scale[..., None] * turned
    return logarithm


def right_jacobian(turn: FloatArray) -> FloatArray:
    """Differentiate the exponential: ``Exp(turn + d) = Exp(turn) Exp(J_r(turn) d)`` to first order.

    Parameters
    ----------
    turn
        Rotation vectors in rad, shape (..., 3). The left Jacobian is that of ``-turn``.

    Returns
    -------
    FloatArray
        Shape (..., 3, 3).
    """
    square = dot(turn, turn)
    angle = np.sqrt(square)
    safe = np.where(angle > _SMALL_RAD, angle, 1.0)
    first = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 - cos a) / a^2
    second = np.where(
        angle > _SMALL_RAD, (safe - np.sin(safe)) / safe**3, 1 / 6 - square / 120 + square**2 / 5040
    )
    cross = skew(turn)
    return np.eye(3) - first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


def inverse_right_jacobian(turn: FloatArray) -> FloatArray:
    """Inverse of :func:`right_jacobian`: ``Log(R Exp(d)) = Log(R) + J_r^-1(Log R) d``; below a turn of pi; (..., 3, 3)."""
    square = dot(turn, turn)
    angle = np.sqrt(square)
    safe = np.where(angle > _SMALL_RAD, angle, 1.0)
    # 1 / a^2 - cot(a / 2) / (2 a)
    second = np.where(
        angle > _SMALL_RAD,
        1 / safe**2 - 1 / (2 * safe * np.tan(safe / 2)),
        1 / 12 + square / 720 + square**2 / 30240,
    )
    cross = skew(turn)
    return np.eye(3) + 0.5 * cross + second[..., None, None] * (cross @ cross)
