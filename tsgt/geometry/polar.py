"""Polar measurements of a total station: conversion, corrections, noise.

The station frame is right-handed with z up. Horizontal angles run clockwise, seen from above, from the x axis; zenith
angles run from straight up. All functions work element by element and broadcast; NaN passes through.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import IDENTITY

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import InstrumentNoise


MIN_SINE = 0.01
"""Sine of the zenith angle below which a collimation error is not corrected: nearly on the vertical axis its effect on the
horizontal angle is no longer linear."""


def polar_to_cartesian(
    horizontal_angle_rad: ArrayLike, zenith_angle_rad: ArrayLike, distance_m: ArrayLike
) -> FloatArray:
    """Points in the station frame, (..., 3) in m, of polar measurements with corrected slope distances.

    Zenith angles above pi are of the second face, where the horizontal angle is turned by pi: the same point.
    """
    return np.asarray(distance_m)[..., None] * _direction(horizontal_angle_rad, zenith_angle_rad)


def cartesian_to_polar(points: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """First-face polar coordinates of points in the station frame, (..., 3) in m; inverse of :func:`polar_to_cartesian`.

    Returns horizontal angle in rad in [0, 2 pi), zenith angle in rad in [0, pi], distance in m. An undefined angle is 0: the
    horizontal angle on the vertical axis, both angles at the station itself.
    """
    x, y, z = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    horizontal_m = np.hypot(x, y)
    around = np.where(horizontal_m == 0, 0.0, np.mod(np.arctan2(-y, x), 2 * np.pi))
    # The remainder of a tiny negative angle rounds up to 2 pi.
    around = np.where(around >= 2 * np.pi, 0.0, around)
    zenith_angle_rad = np.where((horizontal_m == 0) & (z == 0), 0.0, np.arctan2(horizontal_m, z))
    return around, zenith_angle_rad, np.hypot(horizontal_m, z)


def corrected_distance(slope_distance_m: ArrayLike, *, constant_m: float, ppm: float) -> FloatArray:
    """Corrected slope distance in m: atmospheric ppm of the raw distance, and the prism constant, which is not scaled."""
    return np.asarray(slope_distance_m, dtype=np.float64) * (1 + ppm * 1e-6) + constant_m


def corrected_angles(
    horizontal_angle_rad: ArrayLike,
    zenith_angle_rad: ArrayLike,
    *,
    vertical_index_rad: float,
    collimation_rad: float,
) -> tuple[FloatArray, FloatArray]:
    """Horizontal and zenith angles in rad without the instrument's vertical index and collimation errors.

    The zenith angle reads ``z + index`` in the first face and ``2 pi - z + index`` in the second. The line of sight deviates
    clockwise by the collimation error, and the horizontal angle reads that over sin(zenith angle) too small; the sine, and so
    the correction, changes its sign with the face. Straight up or down, where it diverges, it is left out.
    """
    zenith = np.asarray(zenith_angle_rad, dtype=np.float64)
    sine = np.sin(zenith)
    steep = np.abs(sine) < MIN_SINE
    horizontal = np.asarray(horizontal_angle_rad, dtype=np.float64) + np.where(
        steep, 0.0, collimation_rad / np.where(steep, 1.0, sine)
    )
    return horizontal, zenith - vertical_index_rad


def raw_distance(distance_m: ArrayLike, *, constant_m: float, ppm: float) -> FloatArray:
    """Raw slope distance in m; inverse of :func:`corrected_distance`."""
    return (np.asarray(distance_m, dtype=np.float64) - constant_m) / (1 + ppm * 1e-6)


def measurement_covariance(
    horizontal_angle_rad: ArrayLike,
    zenith_angle_rad: ArrayLike,
    distance_m: ArrayLike,
    noise: InstrumentNoise,
) -> FloatArray:
    """Covariance of measured points in the station frame, (..., 3, 3) in m^2.

    The range's constant and ppm parts are independent and add as variances. The horizontal angle's sigma is the angle
    sigma over sin(zenith angle), and the point moves by distance x sin(zenith angle) per rad of it. The sines cancel:
    across the line of sight the noise is distance x angle sigma in all directions, straight up as well.
    """
    distance_m = np.asarray(distance_m, dtype=np.float64)
    direction = _direction(horizontal_angle_rad, zenith_angle_rad)
    along = noise.range_sigma_m**2 + (noise.range_sigma_ppm * 1e-6 * distance_m) ** 2
    across = (noise.angle_sigma_rad * distance_m) ** 2
    outer = direction[..., :, None] * direction[..., None, :]
    isotropic = (across + noise.pointing_sigma_m**2)[..., None, None] * IDENTITY
    return isotropic + (along - across)[..., None, None] * outer


def _direction(horizontal_angle_rad: ArrayLike, zenith_angle_rad: ArrayLike) -> FloatArray:
    """Return the unit vector of the line of sight in the station frame, (..., 3)."""
    h = np.asarray(horizontal_angle_rad, dtype=np.float64)
    z = np.asarray(zenith_angle_rad, dtype=np.float64)
    sin_z = np.sin(z)
    x = sin_z * np.cos(h)
    direction = np.empty((*x.shape, 3))
    direction[..., 0], direction[..., 1], direction[..., 2] = x, -sin_z * np.sin(h), np.cos(z)
    return direction
