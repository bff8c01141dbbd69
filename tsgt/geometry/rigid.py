"""Rotations and rigid transforms.

``T_a_b`` maps coordinates in frame b to frame a. All functions broadcast over leading dimensions, and they give
the same bits for an item alone as for the same item in a batch: element by element, no reduction over a batch.

Derivatives of rotations.

Where a turn is small, digits are lost in what its square is multiplied by; so few that the square has none there.

G. S. Chirikjian, "Stochastic models, information theory, and Lie groups", volume 2, section 10.8; T. D. Barfoot, "State
estimation for robotics", section 7.1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

FloatArray = NDArray[np.float64]

RIGID_TOLERANCE = 1e-6
"""How far a rotation matrix may be from orthonormal: six decimals, as people type them into a file."""

TINY = 1e-300
"""Added to a square, it changes none but zero, which may then be divided by."""

IDENTITY = np.eye(3)

_ACROSS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)
"""Matrices of the cross products with the three axes, a row each."""


def skew(v: FloatArray) -> FloatArray:
    """Matrix of the cross product: ``skew(v) @ p`` is ``v`` x ``p``.

    Parameters
    ----------
    v
        Vectors, shape (..., 3).

    Returns
    -------
    FloatArray
        Skew-symmetric matrices, shape (..., 3, 3).
    """
    v = np.asarray(v, dtype=np.float64)
    # Each element is one of the vector's or zero, so that nothing is rounded.
    matrix: FloatArray = (v @ _ACROSS).reshape(*v.shape, 3)
    return matrix


def exp_so3(w: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector (Rodrigues' formula).

    Parameters
    ----------
    w
        Rotation vectors in rad, shape (..., 3): the axis, as long as the angle.

    Returns
    -------
    FloatArray
        Rotation matrices, shape (..., 3, 3).
    """
    w = np.asarray(w, dtype=np.float64)
    # sin(a)/a and (1 - cos(a))/a^2, both by the half angle: smooth through zero without a branch.
    half_rad = 0.5 * np.sqrt(dot(w, w) + TINY)[..., None, None]
    ratio = np.sin(half_rad) / half_rad
    across = skew(w)
    matrix: FloatArray = (
        IDENTITY + ratio * np.cos(half_rad) * across + 0.5 * ratio * ratio * (across @ across)
    )
    return matrix


def log_so3(R: FloatArray) -> FloatArray:
    """Rotation vector of a rotation matrix; inverse of :func:`exp_so3`.

    Parameters
    ----------
    R
        Rotation matrices, shape (..., 3, 3).

    Returns
    -------
    FloatArray
        Rotation vectors in rad, shape (..., 3), of length 0 to pi. At exactly pi the axis has two signs; either
        may come.
    """
    # By way of the quaternion, which is well conditioned at every angle; the trace is not, near 0 and near pi.
    q = quaternion_from_rotation(R)
    sine, cosine = np.sqrt(dot(q[..., :3], q[..., :3])), q[..., 3]
    small = sine < np.finfo(np.float64).tiny
    scale = np.where(small, 2.0, 2.0 * np.arctan2(sine, cosine) / np.where(small, 1.0, sine))
    return scale[..., None] * q[..., :3]


def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """Give the unit quaternion of a rotation matrix (Shepperd 1978: divide by the largest of the four).

    Parameters
    ----------
    R
        Rotation matrices, shape (..., 3, 3).

    Returns
    -------
    FloatArray
        Hamilton quaternions x, y, z, w with w >= 0, shape (..., 4).
    """
    R = np.asarray(R, dtype=np.float64)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    xw, yw, zw = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    # Four times the outer product of the quaternion with itself: each row is the quaternion, scaled.
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
    """Rotation matrix of a quaternion, which need not have unit length.

    Parameters
    ----------
    q
        Hamilton quaternions x, y, z, w, shape (..., 4).

    Returns
    -------
    FloatArray
        Rotation matrices, shape (..., 3, 3).

    Raises
    ------
    GeometryError
        A quaternion is zero or not finite.
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
    """4x4 transform of a rotation and a translation.

    Parameters
    ----------
    R
        Rotation matrices, shape (..., 3, 3).
    t
        Translations in m, shape (..., 3).

    Returns
    -------
    FloatArray
        Transforms, shape (..., 4, 4): ``p_a = R p_b + t``.
    """
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
    """Rotate vectors: ``R v`` for matrices (..., 3, 3) and vectors (..., 3), broadcast over the leading dimensions."""
    x, y, z = v[..., 0, None], v[..., 1, None], v[..., 2, None]
    return R[..., :, 0] * x + R[..., :, 1] * y + R[..., :, 2] * z


def transform_points(T: FloatArray, points: FloatArray) -> FloatArray:
    """Coordinates in frame a of points given in frame b.

    Parameters
    ----------
    T
        Rigid transforms ``T_a_b``, shape (..., 4, 4).
    points
        Points in frame b in m, shape (..., 3). The leading dimensions of the two are broadcast: one transform with
        many points, or each point with its own.

    Returns
    -------
    FloatArray
        Points in frame a in m, shape (..., 3).
    """
    T, points = np.asarray(T, dtype=np.float64), np.asarray(points, dtype=np.float64)
    return rotate(T[..., :3, :3], points) + T[..., :3, 3]


def check_transform(T: ArrayLike) -> None:
    """Refuse what is not one rigid transform.

    Parameters
    ----------
    T
        Expected: shape (4, 4), a proper rotation, last row 0 0 0 1.

    Raises
    ------
    GeometryError
        Wrong shape, not finite, last row wrong, not orthonormal to :data:`RIGID_TOLERANCE`, or mirrored.
    """
    matrix = np.asarray(T, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise GeometryError(f"a rigid transform has 4x4 numbers, got {'x'.join(map(str, matrix.shape))}")
    if not np.isfinite(matrix).all():
        raise GeometryError("a rigid transform has finite numbers only, got NaN or infinity")
    if not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise GeometryError(f"the last row of a rigid transform is 0 0 0 1, got {matrix[3].tolist()}")
    R = matrix[:3, :3]
    error = float(np.abs(R.T @ R - np.eye(3)).max())
    if error > RIGID_TOLERANCE:
        raise GeometryError(
            f"the rotation of a rigid transform is orthonormal, this one is off by {error:.1e}"
        )
    if np.linalg.det(R) < 0:
        raise GeometryError(
            "the rotation of a rigid transform is right-handed, this one mirrors: is an axis negated?"
        )


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Dot products of 3-vectors along the last axis; written out, so that a batch gives the bits of one item."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


_WELL_BELOW_A_RIGHT_ANGLE = 0.5

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
"""The axis after each axis, and the one after that."""


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of vectors along the last axis, (..., 3); numpy's own takes five times as long for a few."""
    product: FloatArray = a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1)
    return product


def matvec(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Products of matrices and vectors, (..., 3); as :func:`~tsgt.geometry.rigid.rotate`, a few in a third of its time.

    It rounds as the matrices lie in memory, so that the same ones taken from elsewhere may give other bits.
    """
    product: FloatArray = (matrix @ vector[..., None])[..., 0]
    return product


def fast_log_so3(R: FloatArray) -> FloatArray:
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
