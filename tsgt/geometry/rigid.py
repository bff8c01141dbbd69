"""Rotations and rigid transforms; Lie group operations of SO(3). ``T_a_b`` maps coordinates in frame b to frame a.

All functions broadcast over leading dimensions and, unless stated otherwise, give the same bits for an item alone as in a
batch. Source: T. D. Barfoot, "State Estimation for Robotics", section 7.1; G. S. Chirikjian, "Stochastic Models, Information
Theory, and Lie Groups", volume 2, section 10.8.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tsgt.errors import GeometryError

FloatArray = NDArray[np.float64]

TINY = 1e-300  # Added to a square before a division: changes nothing but zero
IDENTITY = np.eye(3)

_SO3_GENERATORS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)
"""Flattened skew-symmetric matrices of the three unit vectors, one per row."""


def skew(v: FloatArray) -> FloatArray:
    """Skew-symmetric matrix of a vector, (..., 3) to (..., 3, 3): ``skew(v) @ p`` is ``v`` x ``p``."""
    v = np.asarray(v, dtype=np.float64)
    # Every product is with 0 or ±1: exact.
    matrix: FloatArray = (v @ _SO3_GENERATORS).reshape(*v.shape, 3)
    return matrix


def exp_so3(w: FloatArray) -> FloatArray:
    """Exponential map (Rodrigues' formula): rotation vectors in rad, (..., 3), to rotation matrices, (..., 3, 3)."""
    w = np.asarray(w, dtype=np.float64)
    # sin(a)/a and (1 - cos(a))/a^2 in terms of the half angle: smooth through zero without a branch.
    half_rad = 0.5 * np.sqrt(dot(w, w) + TINY)[..., None, None]
    ratio = np.sin(half_rad) / half_rad
    skew_w = skew(w)
    matrix: FloatArray = (
        IDENTITY + ratio * np.cos(half_rad) * skew_w + 0.5 * ratio * ratio * (skew_w @ skew_w)
    )
    return matrix


def log_so3(R: FloatArray) -> FloatArray:
    """Logarithmic map, inverse of :func:`exp_so3`: rotation matrices, (..., 3, 3), to rotation vectors in rad, (..., 3).

    The angle is in [0, pi]; at exactly pi the sign of the axis is arbitrary.
    """
    # Via the quaternion, which is well conditioned at every angle; the trace is not, near 0 and near pi.
    q = quaternion_from_rotation(R)
    sine, cosine = np.sqrt(dot(q[..., :3], q[..., :3])), q[..., 3]
    small = sine < np.finfo(np.float64).tiny
    scale = np.where(small, 2.0, 2.0 * np.arctan2(sine, cosine) / np.where(small, 1.0, sine))
    return scale[..., None] * q[..., :3]


def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """Return Hamilton quaternions x, y, z, w with w >= 0, (..., 4), of rotations, (..., 3, 3) (S. W. Shepperd, 1978)."""
    R = np.asarray(R, dtype=np.float64)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    xw, yw, zw = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    # Four times the outer product of the quaternion with itself: each row is a scaled quaternion.
    rows = np.empty((*xx.shape, 4, 4))
    rows[..., 0, 0], rows[..., 1, 1] = 1 + xx - yy - zz, 1 - xx + yy - zz
    rows[..., 2, 2], rows[..., 3, 3] = 1 - xx - yy + zz, 1 + xx + yy + zz
    rows[..., 0, 1] = rows[..., 1, 0] = xy
    rows[..., 0, 2] = rows[..., 2, 0] = xz
    rows[..., 1, 2] = rows[..., 2, 1] = yz
    rows[..., 0, 3] = rows[..., 3, 0] = xw
    rows[..., 1, 3] = rows[..., 3, 1] = yw
    rows[..., 2, 3] = rows[..., 3, 2] = zw
    flat = rows.reshape(-1, 4, 4)
    largest = flat.diagonal(axis1=1, axis2=2).argmax(axis=1)
    q: FloatArray = flat[np.arange(len(flat)), largest].reshape(*xx.shape, 4)
    length = np.sqrt(q[..., 0] ** 2 + q[..., 1] ** 2 + q[..., 2] ** 2 + q[..., 3] ** 2)
    return q / np.where(q[..., 3] < 0, -length, length)[..., None]


def rotation_from_quaternion(q: FloatArray) -> FloatArray:
    """Rotation matrices, (..., 3, 3), of Hamilton quaternions x, y, z, w of any length, (..., 4).

    Raises GeometryError: a quaternion is zero or not finite.
    """
    q = np.asarray(q, dtype=np.float64)
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    square = x * x + y * y + z * z + w * w
    if not np.all((square > 0) & np.isfinite(square)):
        raise GeometryError("a quaternion is zero or not finite: expected x, y, z, w of length 1")
    s = 2 / square
    return np.stack(
        [
            np.stack([1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)], axis=-1),
            np.stack([s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)], axis=-1),
            np.stack([s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)], axis=-1),
        ],
        axis=-2,
    )


def transform_from(R: FloatArray, t: FloatArray) -> FloatArray:
    """4x4 transforms of rotations, (..., 3, 3), and translations in m, (..., 3): ``p_a = R p_b + t``."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast(R[..., 0, 0], t[..., 0]).shape, 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def invert(T: FloatArray) -> FloatArray:
    """Inverse of rigid transforms, ``T_b_a`` of ``T_a_b``; shapes (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform_from(R_inverse, -rotate(R_inverse, T[..., :3, 3]))


def rotate(R: FloatArray, v: FloatArray) -> FloatArray:
    """``R v`` for matrices, (..., 3, 3), and vectors, (..., 3), broadcast over the leading dimensions."""
    x, y, z = v[..., 0, None], v[..., 1, None], v[..., 2, None]
    return R[..., :, 0] * x + R[..., :, 1] * y + R[..., :, 2] * z


def transform_points(T: FloatArray, points: FloatArray) -> FloatArray:
    """Transform points in m, (..., 3), from frame b to frame a by ``T_a_b``, (..., 4, 4); leading dimensions broadcast."""
    T, points = np.asarray(T, dtype=np.float64), np.asarray(points, dtype=np.float64)
    return rotate(T[..., :3, :3], points) + T[..., :3, 3]


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Dot products of 3-vectors along the last axis; written out, so that an item in a batch has the bits of one alone."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


_MIN_COSINE = 0.5

_NEXT, _AFTER_NEXT = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Cyclic index of the next axis and of the one after it."""


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of 3-vectors along the last axis; for a few vectors five times as fast as numpy's."""
    product: FloatArray = a.take(_NEXT, -1) * b.take(_AFTER_NEXT, -1) - a.take(_AFTER_NEXT, -1) * b.take(
        _NEXT, -1
    )
    return product


def matvec(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Matrix-vector products, (..., 3); for a few vectors three times as fast as :func:`rotate`.

    Rounding depends on the memory layout of the matrices: not bit-identical between different layouts.
    """
    product: FloatArray = (matrix @ vector[..., None])[..., 0]
    return product


def fast_log_so3(R: FloatArray) -> FloatArray:
    """Logarithmic map for mostly small rotations, (..., 3, 3) to (..., 3); faster than :func:`log_so3`."""
    cosine = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
    if (cosine < _MIN_COSINE).any():
        return log_so3(R)
    axis_sine = 0.5 * (R[..., _AFTER_NEXT, _NEXT] - R[..., _NEXT, _AFTER_NEXT])
    sine = np.sqrt(dot(axis_sine, axis_sine) + TINY)
    logarithm: FloatArray = (np.arctan2(sine, cosine) / sine)[..., None] * axis_sine
    return logarithm


def exp_and_right_jacobian(w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Exponential map and right Jacobian: ``Exp(w + d) = Exp(w) Exp(J_r(w) d)`` to first order in d (Barfoot 7.1).

    Rotation vectors in rad, (..., 3), to rotation matrices and right Jacobians, (..., 3, 3) each. The left Jacobian is
    ``J_l(w) = J_r(-w) = J_r(w)^T``.
    """
    square = dot(w, w)[..., None, None] + TINY
    half = 0.5 * np.sqrt(square)
    ratio = np.sin(half) / half
    first, second = ratio * np.cos(half), 0.5 * ratio * ratio
    third = (1.0 - first) / square
    skew_w = skew(w)
    skew_w_squared = skew_w @ skew_w
    return (
        IDENTITY + first * skew_w + second * skew_w_squared,
        IDENTITY - second * skew_w + third * skew_w_squared,
    )


def inverse_right_jacobian(w: FloatArray) -> FloatArray:
    """Inverse right Jacobian, (..., 3, 3), of vectors below pi (Barfoot 7.1): ``Log(R Exp(d)) = Log(R) + J_r^-1(Log R) d``."""
    square = dot(w, w)[..., None, None] + TINY
    half = 0.5 * np.sqrt(square)
    skew_w = skew(w)
    inverse: FloatArray = IDENTITY + 0.5 * skew_w + (1.0 - half / np.tan(half)) / square * (skew_w @ skew_w)
    return inverse
