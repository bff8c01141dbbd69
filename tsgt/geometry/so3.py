"""Derivatives of rotations.

G. S. Chirikjian, "Stochastic models, information theory, and Lie groups", volume 2, section 10.8; T. D. Barfoot, "State
estimation for robotics", section 7.1.
"""

from __future__ import annotations

import numpy as np

from tsgt.geometry.rigid import FloatArray, dot, skew

_SMALL_RAD = 1e-2


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
