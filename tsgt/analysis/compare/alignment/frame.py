"""Frame of an estimate in ``station1`` by an alignment over all of it or over its start, and its uncertainty under drift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare.alignment.initialisation import rotation_between
from tsgt.geometry import exp_so3, rotate, skew, transform_from

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.alignment.drifting_frame import Noise, Rows
    from tsgt.analysis.compare.relation import Alignment
    from tsgt.geometry import FloatArray

START_S = 5.0
"""Poses of so many seconds are averaged for an alignment at the start: white noise of 10 Hz counts a seventh, drift hardly."""

START_SPREAD_M = 5.0
"""Of positions alone, the start lasts until they spread by as much along a horizontal line: before, they show no direction."""

REST_SPREAD_M = 0.05
"""Rms distance from their mean, below which positions show no direction, but orientations do."""

OUTLIER_RATIO = 5.0  # Of the median distance; drift alone stays below 3
LINE_RATIO = (
    1e-3  # Spread of positions across a line to that along it, below which they leave a rotation open
)

FRAME_NAMES = (
    *(f"frame_{axis}_m" for axis in "xyz"),
    *(f"frame_{axis}_rad" for axis in ("roll", "pitch", "yaw")),
)


@dataclass(frozen=True, slots=True)
class AlignedFrame:
    """A frame, and how it follows its residuals: ``-sum(by_position r_p + by_rotation r_R)``, about the centroid."""

    T_station1_frame: FloatArray  # (4, 4)
    kept: NDArray[np.bool_]  # (N,) rows that are no outliers
    by_position: FloatArray  # (N, 6, 3)
    by_rotation: FloatArray  # (N, 6, 3)
    determined: NDArray[np.bool_]  # (6,) of FRAME_NAMES


def align_frame(
    align: Alignment,
    rows: Rows,
    own_m: FloatArray,
    reference: FloatArray,
    weight: FloatArray,
    usable: NDArray[np.bool_],
) -> AlignedFrame:
    """Align the estimate's scaled positions, (N, 3), and rotations to the sensor's reference poses, (N, 4, 4).

    ``weight``: (N,), by the reference's covariance. ``yaw`` and ``rigid`` are least squares of positions, as usual; of a robot at rest
    the orientations tell the rotation.
    """
    target, target_rotation = reference[:, :3, 3], reference[:, :3, :3]
    kept = usable.copy()
    if align == "start":
        kept &= _start(rows, own_m, usable)
    level = align == "yaw" or (align == "start" and rows.rotation is None)
    mean_rotation = None
    if rows.rotation is not None:
        mean_rotation = rotation_between(
            np.swapaxes(rows.rotation[kept], 1, 2).reshape(-1, 3),
            np.swapaxes(target_rotation[kept], 1, 2).reshape(-1, 3),
        )
    R, t = np.eye(3), np.zeros(3)
    fixed = mean_rotation if align == "start" or _is_at_rest(target[kept]) else None
    if fixed is not None and level:
        fixed = exp_so3(
            np.array([0.0, 0.0, np.arctan2(fixed[1, 0] - fixed[0, 1], fixed[0, 0] + fixed[1, 1])])
        )
    for _ in range(1 if align == "start" else 3):
        w = np.where(kept, weight, 0.0)
        w = w / w.sum()
        mean, target_mean = w @ own_m, w @ target
        if fixed is not None:
            R = fixed
        else:
            R = _rotation(w[:, None] * (own_m - mean), target - target_mean, mean_rotation, level=level)
        t = target_mean - R @ mean
        distance = np.sqrt(((rotate(R, own_m) + t - target) ** 2).sum(axis=1))
        if align != "start":
            kept = usable & (distance <= OUTLIER_RATIO * max(float(np.median(distance[kept])), 1e-6))
    w = np.where(kept, weight, 0.0)
    w = w / w.sum()
    aligned = rotate(R, own_m) + t
    by_position, by_rotation, determined = _gains(aligned, w, level=level, by_orientation=fixed is not None)
    centroid = aligned[usable].mean(axis=0)
    # From the weighted mean of the aligned poses to the centroid of all.
    shift = skew(w @ aligned - centroid)
    by_position[:, :3] += shift @ by_position[:, 3:]
    by_rotation[:, :3] += shift @ by_rotation[:, 3:]
    return AlignedFrame(transform_from(R, t), kept, by_position, by_rotation, determined)


def _is_at_rest(position_m: FloatArray) -> bool:
    return float(np.sqrt(((position_m - position_m.mean(axis=0)) ** 2).sum(axis=1).mean())) < REST_SPREAD_M


def _start(rows: Rows, own_m: FloatArray, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    first = int(np.argmax(usable))
    since_s = rows.since_first_s - rows.since_first_s[first]
    until_s = START_S
    if rows.rotation is None:
        far = usable & (np.sqrt(((own_m - own_m[first]) ** 2)[:, :2].sum(axis=1)) >= START_SPREAD_M)
        until_s = max(until_s, float(since_s[int(np.argmax(far))])) if far.any() else np.inf
    return np.asarray((since_s >= 0.0) & (since_s <= until_s))


def _rotation(
    weighted: FloatArray, target: FloatArray, mean_rotation: FloatArray | None, *, level: bool
) -> FloatArray:
    if level:
        (x, y, _), (u, v, _) = weighted.T, target.T
        return exp_so3(np.array([0.0, 0.0, np.arctan2(x @ v - y @ u, x @ u + y @ v)]))
    spread = np.linalg.svd(weighted.T @ target, compute_uv=False)
    if spread[1] > LINE_RATIO**2 * spread[0]:
        return rotation_between(weighted, target)
    if mean_rotation is None:
        return _rotation(weighted, target, None, level=True)
    # About the line itself, the orientations decide.
    pull = LINE_RATIO * max(float(np.sqrt(spread[0])), 1e-6)
    return rotation_between(
        np.concatenate([weighted, pull * np.eye(3)]), np.concatenate([target, pull * mean_rotation.T])
    )


def _gains(
    aligned: FloatArray, w: FloatArray, *, level: bool, by_orientation: bool
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Gains about the weighted mean, where translation and rotation decouple."""
    n = len(aligned)
    by_position, by_rotation = np.zeros((n, 6, 3)), np.zeros((n, 6, 3))
    by_position[:, :3] = w[:, None, None] * np.eye(3)
    determined = np.ones(6, dtype=np.bool_)
    if level:
        determined[3:5] = False
    if by_orientation:
        by_rotation[:, 3:] = w[:, None, None] * np.diag(determined[3:].astype(np.float64))
        return by_position, by_rotation, determined
    arms = skew(aligned - w @ aligned)
    inertia = (w[:, None, None] * (np.swapaxes(arms, 1, 2) @ arms)).sum(axis=0)
    turning = w[:, None, None] * arms  # J^T = skew(arm)
    if level:
        if inertia[2, 2] > 0:
            by_position[:, 5] = turning[:, 2] / inertia[2, 2]
    else:
        by_position[:, 3:] = np.linalg.pinv(inertia, rcond=LINE_RATIO**2) @ turning
    return by_position, by_rotation, determined


def frame_covariance(
    frame: AlignedFrame,
    rows: Rows,
    aligned_m: FloatArray,
    noise: Noise,
    driven_m: FloatArray,
    reference: FloatArray | None,
) -> FloatArray:
    """Covariance, (6, 6), of a frame as that of the estimate's first pose: by the drift from there on, white noise and the reference.

    ``driven_m``: (K - 1,) from knot to knot. ``reference``: (N, 6, 6) covariance of the sensor's poses, of white noise at these rows.
    """
    walk = noise.walk_per_s * rows.step_s[:, None] + noise.walk_per_m * driven_m[:, None]
    # A step of drift after a knot moves all later rows, and a step of its rotation turns them about the sensor there.
    turned = frame.by_rotation - frame.by_position @ skew(aligned_m)
    both = np.concatenate([frame.by_position, turned], axis=2)
    per_interval = np.zeros((len(rows.knot) - 1, 6, 6))
    np.add.at(per_interval, rows.interval, both)
    later = np.cumsum(per_interval[::-1], axis=0)[::-1]
    by_step = later.copy()
    by_step[:, :, 3:] += later[:, :, :3] @ skew(aligned_m[rows.knot[:-1]])
    covariance = np.einsum("kij,kj,klj->il", by_step, walk, by_step)
    for gain, variance in ((frame.by_position, noise.white[:3]), (frame.by_rotation, noise.white[3:])):
        covariance += np.einsum("nij,j,nlj->il", gain, variance, gain)
    if reference is not None:
        gain = np.concatenate([frame.by_position, frame.by_rotation], axis=2)[frame.kept]
        covariance += (gain @ reference[frame.kept] @ np.swapaxes(gain, 1, 2)).sum(axis=0)
    return np.asarray(covariance)
