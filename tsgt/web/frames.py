"""Rotations and covariances in plain Python: this process does without numpy. Quaternions as in docs/explanation/conventions.md."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import Row4, Vector3


def rotate(q: Row4, v: Vector3) -> Vector3:
    """Return a vector rotated by a unit quaternion [x, y, z, w]."""
    x, y, z, w = q
    vx, vy, vz = v
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def product(a: Row4, b: Row4) -> Row4:
    """Return the quaternion that rotates by ``b`` and then by ``a``."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def inverse(q: Row4) -> Row4:
    """Return the inverse of a unit quaternion."""
    x, y, z, w = q
    return (-x, -y, -z, w)


def add(a: Vector3, b: Vector3) -> Vector3:
    """Return the sum of two vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a: Vector3, b: Vector3) -> Vector3:
    """Return the difference of two vectors."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def direction(horizontal_angle_rad: float, zenith_angle_rad: float) -> Vector3:
    """Return the unit vector of a line of sight in the station frame."""
    s = math.sin(zenith_angle_rad)
    return (
        s * math.cos(horizontal_angle_rad),
        -s * math.sin(horizontal_angle_rad),
        math.cos(zenith_angle_rad),
    )


def worst_sigma(covariance: Sequence[float], first: int) -> float:
    """Return the sigma in the least certain direction of a 3x3 block of a 6x6 covariance, row by row.

    ``first``: 0 for the position, 3 for the rotation. The largest eigenvalue in closed form (Smith, 1961).
    """
    (a, d, e), (_, b, f), (_, _, c) = (
        covariance[6 * row + first : 6 * row + first + 3] for row in range(first, first + 3)
    )
    mean = (a + b + c) / 3
    # Products of absurd numbers are infinite; their powers would raise.
    squares = sum((each - mean) * (each - mean) for each in (a, b, c))
    p = math.sqrt((squares + 2 * (d * d + e * e + f * f)) / 6)
    if p == 0.0:
        return math.sqrt(max(mean, 0.0))
    a, b, c, d, e, f = ((a - mean) / p, (b - mean) / p, (c - mean) / p, d / p, e / p, f / p)
    half_determinant = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2
    largest = mean + 2 * p * math.cos(math.acos(min(max(half_determinant, -1.0), 1.0)) / 3)
    return math.sqrt(max(largest, 0.0))
