"""Another trajectory to compare poses with: a file in the TUM format, in the frame ``station1`` and of the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tsgt.analysis.evaluation.metrics import PoseErrorStatistics, aligned_statistics, interior_mask
from tsgt.errors import InputFileError
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.model import MAX_COORDINATE_M, check_instants

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.evaluation.metrics import Align, AlignedErrorStatistics
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray

MAX_INTERPOLATION_GAP_NS = 100_000_000
"""Reference poses further apart than this say nothing about the time between them: at 0.5 m/s^2 a straight line
misses by 0.6 mm there."""


@dataclass(frozen=True, slots=True)
class Reference:
    """Poses from elsewhere.

    Attributes
    ----------
    stamp_ns
        (N,) on the Unix clock, strictly increasing.
    position_m
        (N, 3) in frame ``station1``.
    orientation_xyzw
        (N, 4).
    """

    stamp_ns: NDArray[np.int64]
    position_m: FloatArray
    orientation_xyzw: FloatArray

    def at(self, stamp_ns: NDArray[np.int64]) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return ``T_station1_robot`` at some instants, (N, 4, 4), and whether it is known there, (N,)."""
        after = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self.stamp_ns) - 1)
        before = after - 1
        step_ns = self.stamp_ns[after] - self.stamp_ns[before]
        known = (stamp_ns >= self.stamp_ns[before]) & (stamp_ns <= self.stamp_ns[after])
        exact = (stamp_ns == self.stamp_ns[before]) | (stamp_ns == self.stamp_ns[after])
        known &= exact | (step_ns <= MAX_INTERPOLATION_GAP_NS)
        poses = np.broadcast_to(np.eye(4), (len(stamp_ns), 4, 4)).copy()
        if known.any():
            start_ns = self.stamp_ns[0]
            turns = Slerp((self.stamp_ns - start_ns) / 1e9, Rotation.from_quat(self.orientation_xyzw))
            rotation = turns((stamp_ns[known] - start_ns) / 1e9).as_matrix()
            share = ((stamp_ns - self.stamp_ns[before]) / step_ns)[known, None]
            position = (1 - share) * self.position_m[before[known]] + share * self.position_m[after[known]]
            poses[known] = transform_from(rotation, position)
        return poses, known


def read_tum(path: Path) -> Reference:
    """Read a trajectory: ``stamp_s x y z qx qy qz qw`` in each line, ``#`` before comments.

    Raises
    ------
    InputFileError
        It cannot be read, has fewer than two poses, or a line is not a pose; times must increase.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputFileError(f"cannot be read: {error.strerror}", path=path) from error
    except UnicodeDecodeError as error:
        raise InputFileError("is no text", path=path) from error
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", maxsplit=1)[0].replace(",", " ").split()
        if not words:
            continue
        stamp_ns, row = _pose(words, path, number)
        if stamps and stamp_ns <= stamps[-1]:
            raise InputFileError(
                "its time is not after that of the line before; sort the poses", path=path, line=number
            )
        stamps.append(stamp_ns)
        rows.append(row)
    if len(rows) < 2:
        raise InputFileError("holds fewer than two poses", path=path)
    numbers = np.array(rows)
    turns = numbers[:, 3:]
    return Reference(
        np.array(stamps, dtype=np.int64), numbers[:, :3], turns / np.linalg.norm(turns, axis=1)[:, None]
    )


def _pose(words: list[str], path: Path, number: int) -> tuple[int, list[float]]:
    """Read one line: the stamp without a float in between, which would not hold its nanoseconds."""
    try:
        stamp_ns = round(Decimal(words[0]) * 1_000_000_000)
        check_instants(stamp_ns)
        row = [float(word) for word in words[1:]]
    except (ValueError, ArithmeticError) as error:  # the latter are decimal's too
        raise InputFileError(
            "is not a pose; expected: stamp_s x y z qx qy qz qw", path=path, line=number
        ) from error
    # A quaternion far from unit length is none: columns of something else.
    near = all(abs(coordinate) <= MAX_COORDINATE_M for coordinate in row[:3])  # which no NaN is
    if len(row) != 7 or not near or not 1e-3 < math.hypot(*row[3:]) < 1e3:
        raise InputFileError("is not a pose; expected: stamp_s x y z qx qy qz qw", path=path, line=number)
    return stamp_ns, row


def match_poses(poses: PoseBatch, reference: Reference) -> tuple[NDArray[np.intp], FloatArray]:
    """Find the valid poses that have a reference, from 2 s after its start to 2 s before its end.

    Returns
    -------
    rows
        (N,) of the poses.
    true
        (N, 4, 4) ``T_station1_robot`` of the reference at their instants.
    """
    ends_ns = int(reference.stamp_ns[0]), int(reference.stamp_ns[-1])
    rows = np.flatnonzero(poses.valid & interior_mask(poses.stamp_ns, *ends_ns))
    true, known = reference.at(poses.stamp_ns[rows])
    return rows[known], true[known]


def compare(poses: PoseBatch, reference: Reference, point_m: FloatArray) -> PoseErrorStatistics:
    """Compare the valid poses with a reference, unaligned, from 2 s after its start to 2 s before its end.

    Parameters
    ----------
    poses
        As computed.
    reference
        Poses of the same robot frame in frame ``station1``.
    point_m
        The point of the robot whose position is compared, (3,): the centroid of the prisms.
    """
    rows, true = match_poses(poses, reference)
    return PoseErrorStatistics.of(_transforms(poses, rows), poses.covariance[rows], true, point_m)


def compare_aligned(
    poses: PoseBatch, reference: Reference, point_m: FloatArray, mode: Align
) -> AlignedErrorStatistics:
    """Compare the same poses as :func:`compare` once they are aligned; see :func:`tsgt.analysis.evaluation.metrics.aligned_statistics`."""
    rows, true = match_poses(poses, reference)
    return aligned_statistics(_transforms(poses, rows), true, point_m, mode)


def _transforms(poses: PoseBatch, rows: NDArray[np.intp]) -> FloatArray:
    return transform_from(rotation_from_quaternion(poses.orientation_xyzw[rows]), poses.position_m[rows])
