"""Robot poses from prism positions: registration, residuals, covariance and twist.

The layout gives the prisms in the robot frame; everything else is in the world frame. A pose covariance follows ROS:
(x, y, z of the robot's origin, rotation about the world's fixed axes x, y, z).
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
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from tsgt.geometry.rigid import FloatArray

MIN_PRISM_DISTANCE_M = 0.01  # Prisms are several centimetres wide: closer is a mistake
MIN_LAYOUT_RATIO = 0.01  # Spread across the best line to that along it; below, noise dominates the roll


@dataclass(frozen=True, slots=True)
class Poses:
    """N poses of the robot in the world."""

    rotation: FloatArray  # (N, 3, 3) ``R_world_robot``. The identity where degenerate.
    translation_m: FloatArray  # (N, 3) the robot's origin in the world
    residuals_m: FloatArray  # (N, P) distance of each measured prism from its fitted position
    rms_m: FloatArray  # (N,) root mean square of the residuals over the prisms
    degenerate: NDArray[np.bool_]  # (N,) the prisms coincide or are collinear: the rotation is undefined


def poses_from_prisms(layout: ArrayLike, points: ArrayLike) -> Poses:
    """Fit the prism layout, (P, 3) in the robot frame, P >= 3, to prisms, (N, P, 3) in the world, in m, in the same order.

    Unweighted (paper section III-D). Raises DegenerateGeometryError: fewer than three prisms in the layout, or they coincide
    or are collinear. Raises GeometryError: wrong shapes or numbers that are not finite.
    """
    fit = (align_triplets if np.shape(layout)[:1] == (3,) else align_many)(layout, points)
    squares = dot(fit.residuals_m, fit.residuals_m)
    # Prism by prism: a sum over an axis may group its terms differently for one pose than for many.
    mean_square = sum((squares[:, i] for i in range(squares.shape[1])), start=np.zeros(len(squares)))
    return Poses(
        rotation=fit.rotation,
        translation_m=fit.translation_m,
        residuals_m=np.sqrt(squares),
        rms_m=np.sqrt(mean_square / squares.shape[1]),
        degenerate=fit.degenerate,
    )


def pose_covariance(layout: FloatArray, rotation: FloatArray, prism_covariances: FloatArray) -> FloatArray:
    """Propagate prism noise through the unweighted fit, to first order.

    From the layout, (P, 3) in the robot frame in m, ``R_world_robot``, (N, 3, 3), and the prisms' covariances, (N, P, 3, 3)
    in the world in m^2, to (N, 6, 6), symmetric: x, y, z of the origin in m, rotation about the world's axes in rad.
    """
    from_robot = rotation[:, None, None]
    gain = _gain(layout).reshape(-1, 2, 3, 3)
    # The gain is constant in the robot frame: displacements are rotated into it, translation and rotation back.
    in_world = (from_robot @ gain @ from_robot.swapaxes(-2, -1)).reshape(*prism_covariances.shape[:2], 6, 3)
    covariance = _over_prisms(in_world @ prism_covariances @ in_world.swapaxes(2, 3))
    return 0.5 * (covariance + covariance.swapaxes(1, 2))


def pose_displacement(layout: FloatArray, rotation: FloatArray, displacements: FloatArray) -> FloatArray:
    """Displacement of the fitted pose, (N, 6, r), by r displacements of the prisms in the world, (N, P, 3, r).

    With the arguments and the axes of :func:`pose_covariance`.
    """
    from_robot = rotation[:, None, None]
    gain = _gain(layout).reshape(-1, 2, 3, 3)
    in_world = (from_robot @ gain @ from_robot.swapaxes(-2, -1)).reshape(*displacements.shape[:2], 6, 3)
    moved: FloatArray = (in_world @ displacements).sum(axis=1)
    return moved


def interpolation_errors(
    layout: FloatArray,
    rotation: FloatArray,
    error_s2: FloatArray,
    *,
    acceleration_sigma_mps2: float,
    angular_acceleration_sigma_radps2: float,
) -> FloatArray:
    """Displacements of prisms by linear interpolation under an unknown acceleration: (N, P, 3, 6) in the world, in m.

    The robot accelerates as a whole: its prisms' errors have one cause and are correlated. What they have in common shifts
    the pose; what differs between them, in time or in place on a rotating robot, rotates it.

    Parameters
    ----------
    layout, rotation : as for :func:`pose_covariance`.
    error_s2 : (N, P) interpolation error per unit of acceleration: see :func:`tsgt.geometry.interpolation_error_s2`.
    acceleration_sigma_mps2 : One sigma, per axis, of the acceleration of the prisms' centroid.
    angular_acceleration_sigma_radps2 : One sigma, per axis, of the robot's angular acceleration.
    """
    arms = skew(layout - layout.mean(axis=0))
    errors = np.empty((*error_s2.shape, 3, 6))
    errors[..., :3] = acceleration_sigma_mps2 * np.eye(3)
    errors[..., 3:] = -angular_acceleration_sigma_radps2 * (rotation[:, None] @ arms)
    return np.asarray(error_s2[..., None, None] * errors)


def twists(
    layout: FloatArray, rotation: FloatArray, prism_velocities_mps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Unweighted least-squares twist of the rigid robot from its prisms' velocities, (N, P, 3) in the world.

    Other arguments as for :func:`pose_covariance`. Returns the velocity of the robot's origin in the world in m/s and
    the angular velocity in the robot frame in rad/s, (N, 3) each.
    """
    in_robot = rotate(np.swapaxes(rotation, 1, 2)[:, None], prism_velocities_mps)
    twist = _over_prisms(rotate(_gain(layout), in_robot))
    return rotate(rotation, twist[:, :3]), twist[:, 3:]


def covariance_over_lever_arm(covariance: FloatArray, arm_m: FloatArray) -> FloatArray:
    """Carry pose covariances, (N, 6, 6) with rotations about fixed axes, over lever arms, (N, 3) along the same axes.

    To first order: a rotation error θ displaces the end of the lever arm by θ x arm.
    """
    by_error = np.tile(np.eye(6), (len(arm_m), 1, 1))
    by_error[:, :3, 3:] = -skew(arm_m)
    moved = by_error @ covariance @ np.swapaxes(by_error, 1, 2)
    return np.asarray(0.5 * (moved + np.swapaxes(moved, 1, 2)))


def check_layout(layout: ArrayLike, names: Sequence[object] | None = None, *, imu: bool = False) -> None:
    """Check that a prism layout, (P, 3) in the robot frame in m, determines poses well; ``names`` are for messages.

    ``imu``: with the robot's IMU one or two prisms suffice, or several in a line.

    Raises DegenerateGeometryError: fewer than three prisms, two of them closer than :data:`MIN_PRISM_DISTANCE_M`, or all
    nearly collinear (:data:`MIN_LAYOUT_RATIO`). Raises GeometryError: wrong shape or numbers that are not finite.
    """
    array = np.asarray(layout, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise GeometryError(f"a prism layout has shape (P, 3), got {array.shape}")
    if len(array) < (1 if imu else MIN_PRISMS):
        raise DegenerateGeometryError(
            f"a pose needs at least {MIN_PRISMS} prisms on the robot, or an IMU and one: the layout has {len(array)}"
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
    if imu:
        return
    along_m, across_m, _ = spread_m(array)
    if across_m < MIN_LAYOUT_RATIO * along_m:
        raise DegenerateGeometryError(
            f"prisms {', '.join(labels[:-1])} and {labels[-1]} lie nearly in a line: they spread {across_m * 1e3:.1f} mm "
            f"across it over {along_m * 1e3:.1f} mm along it; move one of them aside or correct their positions"
        )


def _over_prisms(terms: FloatArray) -> FloatArray:
    """Sum over the second axis, one by one: a sum over an axis may group its terms differently for one pose and for many."""
    return sum((terms[:, i] for i in range(terms.shape[1])), start=np.zeros_like(terms[:, 0]))


def _gain(layout: FloatArray) -> FloatArray:
    """Gain of the fit of a layout: (P, 6, 3) in the robot frame."""
    return _cached_gain(np.asarray(layout, dtype=np.float64).tobytes())


@lru_cache(maxsize=16)
def _cached_gain(layout: bytes) -> FloatArray:
    """Compute the gain once per layout: it costs more than the rest of a single pose."""
    prisms = np.frombuffer(layout).reshape(-1, 3)
    gain = fit_gain(prisms, np.ones(len(prisms)))
    gain.flags.writeable = False
    return gain
