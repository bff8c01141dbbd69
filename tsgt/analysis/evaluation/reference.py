"""Errors of poses against a reference trajectory, a file in the TUM format: of each pose, and of stationary intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tsgt.analysis.evaluation.metrics import PoseErrorStatistics, aligned_statistics, interior_mask
from tsgt.analysis.text_file import read_text
from tsgt.errors import InputFileError
from tsgt.estimation import POINT_COMMENT, parse_reference_point, transform_between
from tsgt.geometry import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform_from,
    transform_points,
)
from tsgt.model import MAX_COORDINATE_M, ROBOT_ORIGIN, ReferencePoint, check_instants

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.evaluation.metrics import Align, AlignedErrorStatistics
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray

MAX_INTERPOLATION_GAP_NS = 100_000_000  # At 0.5 m/s^2 a straight line is off by 0.6 mm


@dataclass(frozen=True, slots=True)
class Reference:
    """N reference poses of a point."""

    stamp_ns: NDArray[np.int64]  # (N,) Unix times, strictly increasing
    position_m: FloatArray  # (N, 3) in frame ``station1``
    orientation_xyzw: FloatArray  # (N, 4)
    reference_point: ReferencePoint = ROBOT_ORIGIN

    def of_point(self, point: ReferencePoint) -> Reference:
        """Return the reference poses of another point."""
        if point == self.reference_point:
            return self
        rotation = rotation_from_quaternion(self.orientation_xyzw)
        T = transform_from(rotation, self.position_m) @ transform_between(self.reference_point, point)
        return Reference(self.stamp_ns, T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3]), point)

    def at(self, stamp_ns: NDArray[np.int64]) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return ``T_station1_point`` interpolated at some instants, (N, 4, 4), and whether it is known there, (N,)."""
        after = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self.stamp_ns) - 1)
        before = after - 1
        step_ns = self.stamp_ns[after] - self.stamp_ns[before]
        known = (stamp_ns >= self.stamp_ns[before]) & (stamp_ns <= self.stamp_ns[after])
        exact = (stamp_ns == self.stamp_ns[before]) | (stamp_ns == self.stamp_ns[after])
        known &= exact | (step_ns <= MAX_INTERPOLATION_GAP_NS)
        poses = np.broadcast_to(np.eye(4), (len(stamp_ns), 4, 4)).copy()
        if known.any():
            start_ns = self.stamp_ns[0]
            slerp = Slerp((self.stamp_ns - start_ns) / 1e9, Rotation.from_quat(self.orientation_xyzw))
            rotation = slerp((stamp_ns[known] - start_ns) / 1e9).as_matrix()
            share = ((stamp_ns - self.stamp_ns[before]) / step_ns)[known, None]
            position = (1 - share) * self.position_m[before[known]] + share * self.position_m[after[known]]
            poses[known] = transform_from(rotation, position)
        return poses, known


def read_tum(path: Path) -> Reference:
    """Read a trajectory: ``stamp_s x y z qx qy qz qw`` in each line; ``#`` starts a comment.

    A comment ``# reference_point: NAME=X,Y,Z,QX,QY,QZ,QW`` states the point of the poses; without it they are of the robot
    frame. Raises InputFileError if it cannot be read, has fewer than two poses, a line is not a pose, or times do not increase.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    point = ROBOT_ORIGIN
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.startswith(POINT_COMMENT):
            point = _stated_point(line, path, number)
            continue
        words = line.split("#", maxsplit=1)[0].replace(",", " ").split()
        if not words:
            continue
        stamp_ns, row = _pose(words, path, number)
        if stamps and stamp_ns <= stamps[-1]:
            raise InputFileError(
                "its time is not later than that of the previous line; sort the poses", path=path, line=number
            )
        stamps.append(stamp_ns)
        rows.append(row)
    if len(rows) < 2:
        raise InputFileError("holds fewer than two poses", path=path)
    numbers = np.array(rows)
    turns = numbers[:, 3:]
    return Reference(
        np.array(stamps, dtype=np.int64),
        numbers[:, :3],
        turns / np.linalg.norm(turns, axis=1)[:, None],
        point,
    )


def _stated_point(line: str, path: Path, number: int) -> ReferencePoint:
    try:
        return parse_reference_point(line.removeprefix(POINT_COMMENT).strip())
    except ValueError as error:
        raise InputFileError(str(error), path=path, line=number) from error


def _pose(words: list[str], path: Path, number: int) -> tuple[int, list[float]]:
    """Parse one line; the timestamp as a decimal, since a float would lose its nanoseconds."""
    try:
        stamp_s = Decimal(words[0])
        if abs(stamp_s.adjusted()) > 20:  # expanding a huge exponent would take forever
            raise ValueError(words[0])
        stamp_ns = round(stamp_s * 1_000_000_000)
        check_instants(stamp_ns)
        row = [float(word) for word in words[1:]]
    except (ValueError, ArithmeticError) as error:  # decimal raises the latter
        raise InputFileError(
            "is not a pose; expected: stamp_s x y z qx qy qz qw", path=path, line=number
        ) from error
    # A quaternion far from unit length indicates columns of another format.
    bounded = all(abs(coordinate) <= MAX_COORDINATE_M for coordinate in row[:3])  # false for NaN
    if len(row) != 7 or not bounded or not 1e-3 < math.hypot(*row[3:]) < 1e3:
        raise InputFileError("is not a pose; expected: stamp_s x y z qx qy qz qw", path=path, line=number)
    return stamp_ns, row


def match_poses(poses: PoseBatch, reference: Reference) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the rows (N,) of valid poses inside the reference, and the true pose of their point, (N, 4, 4), at each."""
    reference = reference.of_point(poses.reference_point)
    ends_ns = int(reference.stamp_ns[0]), int(reference.stamp_ns[-1])
    rows = np.flatnonzero(poses.valid & interior_mask(poses.stamp_ns, *ends_ns))
    true, known = reference.at(poses.stamp_ns[rows])
    return rows[known], true[known]


def compare(poses: PoseBatch, reference: Reference, centroid_m: FloatArray) -> PoseErrorStatistics:
    """Compare valid poses with a reference in frame ``station1``, unaligned, from 2 s after its start to 2 s before its end.

    ``centroid_m``: the prisms' centroid in the frame of the poses' point, (3,).
    """
    rows, true = match_poses(poses, reference)
    return PoseErrorStatistics.of(transforms_of(poses, rows), poses.covariance[rows], true, centroid_m)


def compare_aligned(
    poses: PoseBatch, reference: Reference, centroid_m: FloatArray, mode: Align
) -> AlignedErrorStatistics:
    """Compare the same poses as :func:`compare` after an alignment; see :func:`aligned_statistics`."""
    rows, true = match_poses(poses, reference)
    return aligned_statistics(transforms_of(poses, rows), true, centroid_m, mode)


def transforms_of(poses: PoseBatch, rows: NDArray[np.intp]) -> FloatArray:
    """Return ``T_station1_robot`` of some poses, (N, 4, 4)."""
    return transform_from(rotation_from_quaternion(poses.orientation_xyzw[rows]), poses.position_m[rows])


MIN_STOP_S = 1.0  # Of poses with a reference: shorter intervals are ignored


@dataclass(frozen=True, slots=True)
class CentroidStationary:
    """Position errors of the mean poses at the prisms' centroid; NaN without any."""

    position_mean_mm: float
    position_max_mm: float


@dataclass(frozen=True, slots=True)
class StationaryStatistics:
    """Errors of mean poses over the stationary intervals that count (``stops``), at the reference point; NaN without any."""

    stops: int
    position_mean_mm: float
    position_max_mm: float
    rotation_mean_deg: float
    rotation_max_deg: float
    centroid: CentroidStationary


@dataclass(frozen=True, slots=True)
class StationaryErrors:
    """Errors of the mean poses of K stationary intervals."""

    position_m: FloatArray  # (K,) norm of the position error at the reference point
    centroid_m: FloatArray  # (K,) at the prisms' centroid
    rotation_rad: FloatArray  # (K,) angle of the rotation error

    def statistics(self) -> StationaryStatistics:
        """Summarise the intervals."""
        if not len(self.position_m):
            return StationaryStatistics(0, *(math.nan,) * 4, CentroidStationary(math.nan, math.nan))
        position_mm, rotation_deg = 1e3 * self.position_m, np.degrees(self.rotation_rad)
        centroid_mm = 1e3 * self.centroid_m
        return StationaryStatistics(
            stops=len(position_mm),
            position_mean_mm=float(position_mm.mean()),
            position_max_mm=float(position_mm.max()),
            rotation_mean_deg=float(rotation_deg.mean()),
            rotation_max_deg=float(rotation_deg.max()),
            centroid=CentroidStationary(float(centroid_mm.mean()), float(centroid_mm.max())),
        )


def stationary_errors(
    poses: PoseBatch, reference: Reference, stationary_ns: Sequence[tuple[int, int]], centroid_m: FloatArray
) -> StationaryErrors:
    """Compare the mean pose of each stationary interval with the mean of the reference at the same instants, unaligned.

    Invalid poses are ignored; ``stationary_ns``: start and end in Unix ns; ``centroid_m``: as for :func:`compare`.
    One entry per interval with poses that have a reference for at least :data:`MIN_STOP_S`.
    """
    period_s = float(np.median(np.diff(poses.stamp_ns))) / 1e9 if len(poses) > 1 else 0.0
    reference = reference.of_point(poses.reference_point)
    position_m, at_centroid_m, rotation_rad = [], [], []
    for start_ns, end_ns in stationary_ns:
        rows = np.flatnonzero(poses.valid & (poses.stamp_ns >= start_ns) & (poses.stamp_ns <= end_ns))
        true, known = reference.at(poses.stamp_ns[rows])
        rows, true = rows[known], true[known]
        if not len(rows) or round(len(rows) * period_s, 6) < MIN_STOP_S:
            continue
        rotation = rotation_from_quaternion(poses.orientation_xyzw[rows])
        estimated = transform_from(rotation, poses.position_m[rows])
        error_m, centroid_error_m = (
            (transform_points(estimated, m) - transform_points(true, m)).mean(axis=0)
            for m in (np.zeros(3), centroid_m)
        )
        mean, true_mean = (Rotation.from_matrix(T[:, :3, :3]).mean() for T in (estimated, true))
        position_m.append(float(np.linalg.norm(error_m)))
        at_centroid_m.append(float(np.linalg.norm(centroid_error_m)))
        rotation_rad.append(float((true_mean.inv() * mean).magnitude()))
    return StationaryErrors(np.array(position_m), np.array(at_centroid_m), np.array(rotation_rad))
