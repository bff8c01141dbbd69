"""From noise on the prisms to errors of the pose: the paper's perturbation study, for any layout.

White noise of a given sigma is put on every coordinate of every prism, the layout is fitted to the result as it is
to measurements, and the error of the pose is kept. The true pose is the identity: noise that is alike in all
directions does not care where the robot stands and how it is turned. Source: Vaidis et al. 2021, section IV-E.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry import check_layout, log_so3, pose_covariance, poses_from_prisms, rotate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.geometry import FloatArray

# A few rounds are enough: the error of the distances is very nearly proportional to the noise.
_ROUNDS = 20
_CLOSE_ENOUGH = 1e-9


@dataclass(frozen=True, slots=True)
class Perturbation:
    """What noise of one size does to the pose; means and standard deviations over the draws.

    Attributes
    ----------
    noise_m
        One sigma of the noise on each coordinate of each prism, in m.
    inter_prism_mean_m
        Mean of |measured - true distance| over all pairs of prisms, in m.
    inter_prism_std_m
        Its standard deviation in m.
    position_mean_m, position_std_m, position_abs_mean_m
        Error of the position along x, y, z of the robot frame in m, shape (3,): mean, standard deviation, and mean of
        its absolute value.
    euler_mean_rad, euler_std_rad, euler_abs_mean_rad
        The same of the rotation as angles about x, y, z (roll, pitch, yaw; R = Rz Ry Rx) in rad, shape (3,).
    position_norm_mean_m, position_norm_std_m
        Length of the position error in m.
    rotation_norm_mean_rad, rotation_norm_std_rad
        Angle of the rotation error in rad.
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
    draws: int,
    point_m: FloatArray,
    random: np.random.Generator,
    on_progress: Callable[[float], None] | None = None,
) -> list[Perturbation]:
    """Put noise of several sizes on the prisms and fit the pose many times each.

    Parameters
    ----------
    layout
        The P >= 3 prisms in the robot frame in m, shape (P, 3).
    noises_m
        One sigma of the noise in m, one or more.
    draws
        How many poses for each.
    point_m
        The point of the robot whose position counts, in the robot frame in m, shape (3,).
    random
        Source of the noise; independent for each size.
    on_progress
        Told the share that is done.

    Returns
    -------
    list of Perturbation
        One per noise, in their order.

    Raises
    ------
    GeometryError
        A layout from which no pose follows.
    """
    check_layout(layout)
    found = []
    for noise_m in noises_m:
        found.append(
            perturbed(layout, noise_m, random.standard_normal((draws, *layout.shape)), point_m=point_m)
        )
        if on_progress is not None:
            on_progress(len(found) / len(noises_m))
    return found


def perturbed(
    layout: FloatArray, noise_m: float, unit_noise: FloatArray, *, point_m: FloatArray
) -> Perturbation:
    """Fit the pose to prisms with the given noise on them.

    Parameters
    ----------
    layout, point_m
        As for :func:`perturbation_study`.
    noise_m
        Size of the noise in m.
    unit_noise
        The noise, of sigma 1, shape (N, P, 3).
    """
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
    draws: int,
    point_m: FloatArray,
    random: np.random.Generator,
) -> Perturbation:
    """Find the noise that gives a mean inter-prism error, and what it does to the pose.

    The inter-prism error can be measured in the field, and the noise on the prisms cannot.

    Parameters
    ----------
    layout, draws, point_m, random
        As for :func:`perturbation_study`.
    inter_prism_m
        Mean of |measured - true distance| in m, above zero.

    Raises
    ------
    GeometryError
        A layout from which no pose follows, or an error of which no noise is the cause: it is as large as the layout.
    """
    check_layout(layout)
    unit_noise = random.standard_normal((draws, *layout.shape))
    # The difference of two prisms has sqrt(2) sigma along their line; its absolute value sqrt(2 / pi) of that.
    noise_m = inter_prism_m * math.sqrt(math.pi) / 2
    for _ in range(_ROUNDS):
        found_m = float(_distance_errors_m(layout, layout + noise_m * unit_noise).mean())
        if abs(found_m / inter_prism_m - 1) < _CLOSE_ENOUGH:
            return perturbed(layout, noise_m, unit_noise, point_m=point_m)
        noise_m *= inter_prism_m / found_m
    raise GeometryError(f"no noise found that gives a mean inter-prism error of {inter_prism_m * 1e3:g} mm")


def first_order_sigmas(
    layout: FloatArray, noise_m: float, *, point_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Propagate the noise to first order: what the draws must show where it is small.

    Parameters
    ----------
    layout, point_m
        As for :func:`perturbation_study`.
    noise_m
        One sigma of the noise in m.

    Returns
    -------
    position_m : FloatArray
        One sigma along x, y, z in m, shape (3,).
    rotation_rad : FloatArray
        One sigma about x, y, z in rad, shape (3,).
    """
    covariances = np.broadcast_to(noise_m**2 * np.eye(3), (1, *layout.shape, 3))
    # Seen from the point, it is the origin, whose covariance the propagation gives.
    (covariance,) = pose_covariance(layout - point_m, np.eye(3)[None], covariances)
    sigmas = np.sqrt(np.diag(covariance))
    return sigmas[:3], sigmas[3:]


def euler_angles_rad(R: FloatArray) -> FloatArray:
    """Roll, pitch and yaw of rotations in rad, shape (..., 3): R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    # By way of two elements: the arcsine of one is ill conditioned near a quarter turn.
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 2, 1], R[..., 2, 2]))
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return np.stack([roll, pitch, yaw], axis=-1)


def _distance_errors_m(layout: FloatArray, points: FloatArray) -> FloatArray:
    """|measured - true distance| of all pairs in m, shape (N, pairs)."""
    first, second = np.array(list(combinations(range(len(layout)), 2))).T
    true_m = np.linalg.norm(layout[first] - layout[second], axis=-1)
    errors: FloatArray = np.abs(np.linalg.norm(points[:, first] - points[:, second], axis=-1) - true_m)
    return errors
