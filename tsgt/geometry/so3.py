"""Derivatives of rotations.

Where a turn is small, digits are lost in what its square is multiplied by; so few that the square has none there.

G. S. Chirikjian, "Stochastic models, information theory, and Lie groups", volume 2, section 10.8; T. D. Barfoot, "State
estimation for robotics", section 7.1.
"""

from __future__ import annotations

import numpy as np

from tsgt.geometry.rigid import IDENTITY, TINY, FloatArray, dot, log_so3, skew

_WELL_BELOW_A_RIGHT_ANGLE = 0.5

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
"""The axis after each axis, and the one after that."""


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of vectors along the last axis, (..., 3); numpy's own takes five times as long for a few."""
    product: FloatArray = a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1)
    return product


def apply(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Products of matrices and vectors, (..., 3); as :func:`~tsgt.geometry.rigid.rotate`, a few in a third of its time.

    It rounds as the matrices lie in memory, so that the same ones taken from elsewhere may give other bits.
    """
    product: FloatArray = (matrix @ vector[..., None])[..., 0]
    return product


def log_of_steps(R: FloatArray) -> FloatArray:
    """Rotation vectors of rotations that are mostly small, (..., 3); as :func:`~tsgt.geometry.rigid.log_so3`, but faster."""
    cosine = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
    if (cosine < _WELL_BELOW_A_RIGHT_ANGLE).any():
        return log_so3(R)
    turned = 0.5 * (R[..., _LAST, _NEXT] - R[..., _NEXT, _LAST])
    sine = np.sqrt(dot(turned, turned) + TINY)
    logarithm: FloatArray = (np.arctan2(sine, cosine) / sine)[..., None] * turned
    return logarithm


def exp_and_right_jacobian(turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotate, and differentiate that: ``Exp(turn + d) = Exp(turn) Exp(J_r(turn) d)`` to first order.

    Parameters
    ----------
    turn
        Rotation vectors in rad, shape (..., 3).

    Returns
    -------
    rotation : FloatArray
        As :func:`~tsgt.geometry.rigid.exp_so3`, shape (..., 3, 3).
    right_jacobian : FloatArray
        Shape (..., 3, 3). The left Jacobian is that of ``-turn``, and its transpose.
    """
    square = dot(turn, turn)[..., None, None] + TINY
    half = 0.5 * np.sqrt(square)
    ratio = np.sin(half) / half
    first, second = ratio * np.cos(half), 0.5 * ratio * ratio
    third = (1.0 - first) / square
    across = skew(turn)
    twice = across @ across
    return IDENTITY + first * across + second * twice, IDENTITY - second * across + third * twice


def inverse_right_jacobian(turn: FloatArray) -> FloatArray:
    """Inverse of the right Jacobian: ``Log(R Exp(d)) = Log(R) + J_r^-1(Log R) d``; below a turn of pi; (..., 3, 3)."""
    square = dot(turn, turn)[..., None, None] + TINY
    half = 0.5 * np.sqrt(square)
    across = skew(turn)
    inverse: FloatArray = IDENTITY + 0.5 * across + (1.0 - half / np.tan(half)) / square * (across @ across)
    return inverse
