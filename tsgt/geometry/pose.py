"""Poses of the robot from the positions of its prisms, with residuals, covariance and twist.

The layout gives the prisms in the robot frame; everything else is in the world frame. A pose covariance is that of
ROS: (x, y, z of the robot's origin, rotation about the world's fixed axes x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry.alignment import align_many, align_triplets, fit_gain, spread_m
from tsgt.geometry.rigid import dot, rotate, skew

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from tsgt.geometry.rigid import FloatArray

MIN_PRISM_DISTANCE_M = 0.01
"""Prisms are several centimetres wide: centres closer than this are a slip in the layout, not a robot."""

MIN_LAYOUT_RATIO = 0.01
"""Layouts flatter than this (spread across their best line over spread along it) leave the roll about it to noise."""


@dataclass(frozen=True, slots=True)
class Poses:
    """N poses of the robot in the world.

    Attributes
    ----------
    rotation
        ``R_world_robot``, shape (N, 3, 3). The identity where degenerate.
    translation_m
        The robot's origin in the world in m, shape (N, 3).
    residuals_m
        How far each measured prism lies from where the pose puts it, in m, shape (N, P).
    rms_m
        Root mean square of these over the prisms in m, shape (N,).
    degenerate
        The prisms coincide or lie in a line: no rotation follows from them. Shape (N,).
    """

    rotation: FloatArray
    translation_m: FloatArray
    residuals_m: FloatArray
    rms_m: FloatArray
    degenerate: NDArray[np.bool_]


def poses_from_prisms(layout: ArrayLike, points: ArrayLike) -> Poses:
    """Fit the prism layout to measured prisms (paper section III-D), unweighted.

    Parameters
    ----------
    layout
        The P >= 3 prisms in the robot frame in m, shape (P, 3).
    points
        The prisms in the world in m, shape (N, P, 3), in the same order.

    Returns
    -------
    Poses
        One per row of ``points``.

    Raises
    ------
    DegenerateGeometryError
        The layout's prisms are fewer than three, coincide or lie in a line.
    GeometryError
        Wrong shapes or numbers that are not finite.
    """
    fit = (align_triplets if np.shape(layout)[:1] == (3,) else align_many)(layout, points)
    squares = dot(fit.residuals_m, fit.residuals_m)
    # Prism by prism, as a sum over an axis may group its terms differently for one pose than for many.
    mean_square = sum((squares[:, i] for i in range(squares.shape[1])), start=np.zeros(len(squares)))
    return Poses(
        rotation=fit.rotation,
        translation_m=fit.translation_m,
        residuals_m=np.sqrt(squares),
        rms_m=np.sqrt(mean_square / squares.shape[1]),
        degenerate=fit.degenerate,
    )


def pose_covariance(layout: FloatArray, rotation: FloatArray, prism_covariances: FloatArray) -> FloatArray:
    """Propagate the noise of the prisms through the unweighted fit, to first order.

    Parameters
    ----------
    layout
        The prisms in the robot frame in m, shape (P, 3).
    rotation
        ``R_world_robot`` of the poses, shape (N, 3, 3).
    prism_covariances
        Covariances of the measured prisms in the world in m^2, shape (N, P, 3, 3).

    Returns
    -------
    FloatArray
        Shape (N, 6, 6), symmetric: (x, y, z of the robot's origin in m, rotation about the world's axes in rad).
    """
    from_robot = rotation[:, None, None]
    gain = _layout_gain(layout).reshape(-1, 2, 3, 3)  # that of the translation, that of the rotation
    # The gain is constant in the robot frame; displacements go there, translation and rotation come back.
    in_world = (from_robot @ gain @ from_robot.swapaxes(-2, -1)).reshape(*prism_covariances.shape[:2], 6, 3)
    covariance = _over_prisms(in_world @ prism_covariances @ in_world.swapaxes(2, 3))
    return 0.5 * (covariance + covariance.swapaxes(1, 2))


def interpolation_error_covariance(
    layout: FloatArray,
    rotation: FloatArray,
    unseen: FloatArray,
    *,
    acceleration_sigma_mps2: float,
    angular_acceleration_sigma_radps2: float,
) -> FloatArray:
    """Propagate a robot's unknown acceleration, which straight-line interpolation does not see, through the fit.

    The robot accelerates as a whole: the errors of its prisms have one cause and are far from independent. What is
    common to them moves the pose; only what differs, in time to the next measurement or in place on a turning robot,
    turns it.

    Parameters
    ----------
    layout
        The prisms in the robot frame in m, shape (P, 3).
    rotation
        ``R_world_robot`` of the poses, shape (N, 3, 3).
    unseen
        By how much each prism's interpolation misses per unit of acceleration, in s^2, shape (N, P): see
        :func:`tsgt.geometry.interpolation_error_s2`.
    acceleration_sigma_mps2
        One sigma, per axis, of the acceleration of the prisms' centroid.
    angular_acceleration_sigma_radps2
        One sigma, per axis, of the robot's angular acceleration.

    Returns
    -------
    FloatArray
        Shape (N, 6, 6), in the order and axes of :func:`pose_covariance`, to which it adds.
    """
    effects = _over_prisms(unseen[:, :, None, None, None] * _acceleration_gains(layout))
    # From the robot frame, in which the gains are constant, to the world: translation and rotation, each by itself.
    blocks = effects.reshape(-1, 2, 2, 3, 3)
    in_world = (rotation[:, None, None] @ blocks).reshape(effects.shape)
    covariances = in_world @ np.ascontiguousarray(in_world.swapaxes(2, 3))
    covariance = np.zeros((len(rotation), 6, 6))
    covariance += acceleration_sigma_mps2**2 * covariances[:, 0]
    covariance += angular_acceleration_sigma_radps2**2 * covariances[:, 1]
    return covariance


def twists(
    layout: FloatArray, rotation: FloatArray, prism_velocities_mps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Velocity and angular velocity of the rigid robot that fit the prisms' velocities best, unweighted.

    Parameters
    ----------
    layout
        The prisms in the robot frame in m, shape (P, 3).
    rotation
        ``R_world_robot`` of the poses, shape (N, 3, 3).
    prism_velocities_mps
        Velocities of the prisms in the world in m/s, shape (N, P, 3).

    Returns
    -------
    velocity_mps : FloatArray
        Velocity of the robot's origin in the world in m/s, shape (N, 3).
    angular_velocity_radps : FloatArray
        Angular velocity in the robot frame in rad/s, shape (N, 3).
    """
    in_robot = rotate(np.swapaxes(rotation, 1, 2)[:, None], prism_velocities_mps)
    twist = _over_prisms(rotate(_layout_gain(layout), in_robot))
    return rotate(rotation, twist[:, :3]), twist[:, 3:]


def check_layout(layout: ArrayLike, names: Sequence[object] | None = None) -> None:
    """Refuse a prism layout from which no pose can be computed well.

    Parameters
    ----------
    layout
        The prisms in the robot frame in m, shape (P, 3).
    names
        What the prisms are called in messages; their numbers from 1 when not given.

    Raises
    ------
    DegenerateGeometryError
        Fewer than three prisms, two of them closer than :data:`MIN_PRISM_DISTANCE_M`, or all of them nearly in a line
        (:data:`MIN_LAYOUT_RATIO`).
    GeometryError
        Wrong shape or numbers that are not finite.
    """
    array = np.asarray(layout, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise GeometryError(f"a prism layout has shape (P, 3), got {array.shape}")
    if len(array) < 3:
        raise DegenerateGeometryError(
            f"a pose needs at least 3 prisms on the robot, the layout has {len(array)}"
        )
    if not np.isfinite(array).all():
        raise GeometryError("a prism layout has finite numbers only, got NaN or infinity")
    labels = [str(name) for name in (range(1, len(array) + 1) if names is None else names)]
    for i, j in combinations(range(len(array)), 2):
        distance_m = float(np.linalg.norm(array[i] - array[j]))
        if distance_m < MIN_PRISM_DISTANCE_M:
            raise DegenerateGeometryError(
                f"prisms {labels[i]} and {labels[j]} are {distance_m * 1e3:.1f} mm apart, expected at least "
                f"{MIN_PRISM_DISTANCE_M * 1e3:.0f} mm: correct their positions on the robot"
            )
    along_m, across_m, _ = spread_m(array)
    if across_m < MIN_LAYOUT_RATIO * along_m:
        raise DegenerateGeometryError(
            f"prisms {', '.join(labels[:-1])} and {labels[-1]} lie nearly in a line: they spread {across_m * 1e3:.1f} mm "
            f"across it over {along_m * 1e3:.1f} mm along it; move one of them aside or correct their positions"
        )


def _over_prisms(terms: FloatArray) -> FloatArray:
    """Sum over the second axis, one by one: a sum over an axis may group its terms differently for one pose and for many."""
    return sum((terms[:, i] for i in range(terms.shape[1])), start=np.zeros_like(terms[:, 0]))


def _layout_gain(layout: FloatArray) -> FloatArray:
    """Gain of each prism in the unweighted fit, in the robot frame; shape (P, 6, 3)."""
    return _gains(np.asarray(layout, dtype=np.float64).tobytes())[0]


def _acceleration_gains(layout: FloatArray) -> FloatArray:
    """Gains of the robot's acceleration and of its angular acceleration by way of each prism, in the robot frame; shape (P, 2, 6, 3)."""
    return _gains(np.asarray(layout, dtype=np.float64).tobytes())[1]


@lru_cache(maxsize=16)
def _gains(layout: bytes) -> tuple[FloatArray, FloatArray]:
    """All gains of a layout; a robot keeps its own for years, and they cost more than all else of a single pose."""
    prisms = np.frombuffer(layout).reshape(-1, 3)
    gain = fit_gain(prisms, np.ones(len(prisms)))
    turning = gain @ skew(prisms - prisms.mean(axis=0))
    both = np.stack([gain, turning], axis=1)
    gain.flags.writeable = both.flags.writeable = False
    return gain, both
