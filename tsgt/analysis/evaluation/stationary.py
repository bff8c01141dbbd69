"""Errors of the mean pose of each stationary interval against a reference: what averaging over noise leaves. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from tsgt.geometry import rotation_from_quaternion, transform_from, transform_points

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.evaluation.reference import Reference
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray

MIN_POSES = 20
"""One second at 20 Hz: intervals with fewer poses are ignored."""


@dataclass(frozen=True, slots=True)
class StationaryStatistics:
    """Errors of mean poses over the stationary intervals that count (``stops``); NaN without any."""

    stops: int
    position_mean_mm: float
    position_max_mm: float
    rotation_mean_deg: float
    rotation_max_deg: float


@dataclass(frozen=True, slots=True)
class StationaryErrors:
    """Errors of the mean pose of each of K stationary intervals.

    Attributes
    ----------
    position_m
        (K,) norm of the position error at the chosen point of the robot.
    rotation_rad
        (K,) angle of the rotation error.
    """

    position_m: FloatArray
    rotation_rad: FloatArray

    def statistics(self) -> StationaryStatistics:
        """Summarise the intervals."""
        if not len(self.position_m):
            return StationaryStatistics(0, *(math.nan,) * 4)
        position_mm, rotation_deg = 1e3 * self.position_m, np.degrees(self.rotation_rad)
        return StationaryStatistics(
            stops=len(position_mm),
            position_mean_mm=float(position_mm.mean()),
            position_max_mm=float(position_mm.max()),
            rotation_mean_deg=float(rotation_deg.mean()),
            rotation_max_deg=float(rotation_deg.max()),
        )


def stationary_errors(
    poses: PoseBatch, reference: Reference, stationary_ns: Sequence[tuple[int, int]], point_m: FloatArray
) -> StationaryErrors:
    """Compare the mean pose of each stationary interval with the mean of the reference at the same instants, unaligned.

    Parameters
    ----------
    poses
        Invalid ones are ignored.
    reference
        Poses of the same robot frame in frame ``station1``.
    stationary_ns
        Start and end of the intervals, in Unix ns.
    point_m
        Point of the robot whose position is compared, (3,).

    Returns
    -------
    StationaryErrors
        One entry per interval with at least :data:`MIN_POSES` poses that have a reference.
    """
    position_m, rotation_rad = [], []
    for start_ns, end_ns in stationary_ns:
        rows = np.flatnonzero(poses.valid & (poses.stamp_ns >= start_ns) & (poses.stamp_ns <= end_ns))
        true, known = reference.at(poses.stamp_ns[rows])
        rows, true = rows[known], true[known]
        if len(rows) < MIN_POSES:
            continue
        rotation = rotation_from_quaternion(poses.orientation_xyzw[rows])
        estimated = transform_from(rotation, poses.position_m[rows])
        offset = transform_points(estimated, point_m).mean(axis=0) - transform_points(true, point_m).mean(
            axis=0
        )
        mean, true_mean = (Rotation.from_matrix(T[:, :3, :3]).mean() for T in (estimated, true))
        position_m.append(float(np.linalg.norm(offset)))
        rotation_rad.append(float((true_mean.inv() * mean).magnitude()))
    return StationaryErrors(np.array(position_m), np.array(rotation_rad))
