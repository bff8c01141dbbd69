"""How far the mean pose of each stop is from a reference: what is left when noise has averaged out. Pure."""

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
"""One second of poses at 20 Hz: the mean of fewer is not called that of a stop."""


@dataclass(frozen=True, slots=True)
class StationaryStatistics:
    """Errors of mean poses in figures; NaN without any stop.

    Attributes
    ----------
    stops
        How many intervals count.
    position_mean_mm, position_max_mm
        Over the stops: length of the position error of the mean pose.
    rotation_mean_deg, rotation_max_deg
        The same for the angle of its rotation error.
    """

    stops: int
    position_mean_mm: float
    position_max_mm: float
    rotation_mean_deg: float
    rotation_max_deg: float


@dataclass(frozen=True, slots=True)
class StationaryErrors:
    """Errors of the mean pose of each stop.

    Attributes
    ----------
    position_m
        (K,) length of the position error at the chosen point of the robot.
    rotation_rad
        (K,) angle of the rotation error.
    """

    position_m: FloatArray
    rotation_rad: FloatArray

    def statistics(self) -> StationaryStatistics:
        """Sum the stops up."""
        nothing = len(self.position_m) == 0
        position_mm, rotation_deg = 1e3 * self.position_m, np.degrees(self.rotation_rad)
        return StationaryStatistics(
            stops=len(position_mm),
            position_mean_mm=math.nan if nothing else float(position_mm.mean()),
            position_max_mm=math.nan if nothing else float(position_mm.max()),
            rotation_mean_deg=math.nan if nothing else float(rotation_deg.mean()),
            rotation_max_deg=math.nan if nothing else float(rotation_deg.max()),
        )


def stationary_errors(
    poses: PoseBatch, reference: Reference, stationary_ns: Sequence[tuple[int, int]], point_m: FloatArray
) -> StationaryErrors:
    """Compare the mean pose of each stop with the mean of the reference at the same instants, unaligned.

    Parameters
    ----------
    poses
        As computed; only valid ones count.
    reference
        Poses of the same robot frame in frame ``station1``.
    still_ns
        Start and end of the stops, in Unix ns.
    point_m
        The point of the robot whose position is compared, (3,).

    Returns
    -------
    StandingErrors
        One entry for each stop with a second or more of poses that have a reference.
    """
    position_m, rotation_rad = [], []
    for start_ns, end_ns in stationary_ns:
        rows = np.flatnonzero(poses.valid & (poses.stamp_ns >= start_ns) & (poses.stamp_ns <= end_ns))
        true, known = reference.at(poses.stamp_ns[rows])
        rows, true = rows[known], true[known]
        if len(rows) < MIN_POSES:
            continue
        turns = rotation_from_quaternion(poses.orientation_xyzw[rows])
        found = transform_from(turns, poses.position_m[rows])
        offset = transform_points(found, point_m).mean(axis=0) - transform_points(true, point_m).mean(axis=0)
        means = [Rotation.from_matrix(T[:, :3, :3]).mean() for T in (found, true)]
        position_m.append(float(np.linalg.norm(offset)))
        rotation_rad.append(float((means[1].inv() * means[0]).magnitude()))
    return StationaryErrors(np.array(position_m), np.array(rotation_rad))
