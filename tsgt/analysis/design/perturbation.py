"""Perturbation study: errors of the pose due to noise on the prisms, for any layout. Sans-I/O.

White noise is added to every coordinate of every prism, the layout is fitted to the result as to measurements, and the
pose errors are collected. The true pose is the identity: isotropic noise makes the result independent of the pose.
Source: Vaidis et al. 2021, section IV-E.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry import check_layout, euler_angles_rad, log_so3, pose_covariance, poses_from_prisms, rotate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.geometry import FloatArray

# A few iterations suffice: the distance error is very nearly proportional to the noise.
_MAX_ITERATIONS = 20
_RELATIVE_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Perturbation:
    """Pose errors due to noise of one sigma on each coordinate of each prism (``noise_m``), over all samples.

    ``inter_prism``: |measured - true distance| over all pairs of prisms. ``position``: along x, y, z of the robot frame, (3,).
    ``euler``: rotation error about x, y, z (roll, pitch, yaw; R = Rz Ry Rx), (3,). ``norm``: norm of the position error, angle of
    the rotation error. ``mean``, ``std``, ``abs_mean``: mean, standard deviation, mean of the absolute value.
    """

    noise_m: float
    inter_prism_mean_m: float
    inter_prism_std_m: float
    position_mean_m: FloatArray
    position_std_m: FloatArray
    position_abs_mean_m: FloatArray
    euler_mean_rad: FloatArray
    euler_std_rad: FloatArray
    euler_abs_mean_rad: FloatArray
    position_norm_mean_m: float
    position_norm_std_m: float
    rotation_norm_mean_rad: float
    rotation_norm_std_rad: float


def perturbation_study(
    layout: FloatArray,
    noises_m: Sequence[float],
    *,
    samples: int,
    point_m: FloatArray,
    random: np.random.Generator,
    on_progress: Callable[[float], None] | None = None,
) -> list[Perturbation]:
    """Fit the pose to prisms with noise of several sigmas; ``samples`` poses for each, of independent noise.

    ``layout``: P >= 3 prisms, (P, 3), and ``point_m``: the evaluated point, (3,), in the robot frame in m; ``on_progress``
    gets the completed fraction, 0 to 1. Raises GeometryError if the layout determines no pose.
    """
    check_layout(layout)
    found = []
    for noise_m in noises_m:
        found.append(
            perturbed(layout, noise_m, random.standard_normal((samples, *layout.shape)), point_m=point_m)
        )
        if on_progress is not None:
            on_progress(len(found) / len(noises_m))
    return found


def perturbed(
    layout: FloatArray, noise_m: float, unit_noise: FloatArray, *, point_m: FloatArray
) -> Perturbation:
    """Fit the pose to prisms with given noise: ``unit_noise``, (N, P, 3), of sigma 1, scaled by ``noise_m``."""
    points = layout + noise_m * unit_noise
    poses = poses_from_prisms(layout, points)
    position = rotate(poses.rotation, point_m) + poses.translation_m - point_m
    euler = euler_angles_rad(poses.rotation)
    position_norm = np.linalg.norm(position, axis=1)
    rotation_norm = np.linalg.norm(log_so3(poses.rotation), axis=1)
    distances = _distance_errors_m(layout, points)
    return Perturbation(
        noise_m=noise_m,
        inter_prism_mean_m=float(distances.mean()),
        inter_prism_std_m=float(distances.std()),
        position_mean_m=position.mean(axis=0),
        position_std_m=position.std(axis=0),
        position_abs_mean_m=np.abs(position).mean(axis=0),
        euler_mean_rad=euler.mean(axis=0),
        euler_std_rad=euler.std(axis=0),
        euler_abs_mean_rad=np.abs(euler).mean(axis=0),
        position_norm_mean_m=float(position_norm.mean()),
        position_norm_std_m=float(position_norm.std()),
        rotation_norm_mean_rad=float(rotation_norm.mean()),
        rotation_norm_std_rad=float(rotation_norm.std()),
    )


def equivalent_noise(
    layout: FloatArray,
    inter_prism_m: float,
    *,
    samples: int,
    point_m: FloatArray,
    random: np.random.Generator,
) -> Perturbation:
    """Find the noise that causes a mean inter-prism error above zero, which unlike noise can be measured, and its pose errors.

    Arguments as for :func:`perturbation_study`. Raises GeometryError if the layout determines no pose, or the error is as
    large as the layout, so that no noise explains it.
    """
    check_layout(layout)
    unit_noise = random.standard_normal((samples, *layout.shape))
    # The difference of two prisms has sqrt(2) sigma along their line; its absolute value sqrt(2 / pi) of that.
    noise_m = inter_prism_m * math.sqrt(math.pi) / 2
    for _ in range(_MAX_ITERATIONS):
        found_m = float(_distance_errors_m(layout, layout + noise_m * unit_noise).mean())
        if abs(found_m / inter_prism_m - 1) < _RELATIVE_TOLERANCE:
            return perturbed(layout, noise_m, unit_noise, point_m=point_m)
        noise_m *= inter_prism_m / found_m
    raise GeometryError(f"no noise found that gives a mean inter-prism error of {inter_prism_m * 1e3:g} mm")


def first_order_sigmas(
    layout: FloatArray, noise_m: float, *, point_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Propagate small noise to first order: one sigma of position (m) along and rotation (rad) about x, y, z, (3,) each."""
    covariances = np.broadcast_to(noise_m**2 * np.eye(3), (1, *layout.shape, 3))
    # The propagation yields the covariance of the origin, which is moved to the point.
    (covariance,) = pose_covariance(layout - point_m, np.eye(3)[None], covariances)
    sigmas = np.sqrt(np.diag(covariance))
    return sigmas[:3], sigmas[3:]


def _distance_errors_m(layout: FloatArray, points: FloatArray) -> FloatArray:
    """Return |measured - true distance| of all pairs, (N, pairs)."""
    first, second = np.array(list(combinations(range(len(layout)), 2))).T
    true_m = np.linalg.norm(layout[first] - layout[second], axis=-1)
    errors: FloatArray = np.abs(np.linalg.norm(points[:, first] - points[:, second], axis=-1) - true_m)
    return errors
