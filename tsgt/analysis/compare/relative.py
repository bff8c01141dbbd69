"""Errors of the motion between two paired poses: RPE over times and distances, KITTI's segments, drift per metre. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tsgt.analysis.compare.errors import Explained, JudgedErrors, judged
from tsgt.analysis.evaluation import pairs_by_path, pairs_by_time, relative_errors
from tsgt.geometry import invert, log_so3, skew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.pairing import PairedPoses
    from tsgt.geometry import FloatArray

RPE_DISTANCES_M = (1.0, 10.0, 100.0)
RPE_TIMES_S = (1.0, 10.0)
KITTI_LENGTHS_M = tuple(100.0 * n for n in range(1, 9))
MIN_KITTI_PATH_M = (
    200.0  # On a shorter path, KITTI's lengths are divided by 10 until the path is as long in terms of them
)
START_SPACING_S = 1.0  # KITTI: each tenth pose at 10 Hz
_CURVE_LENGTHS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0)
MIN_SEGMENTS = 10  # Fewer say little about a length


@dataclass(frozen=True, slots=True)
class RelativePoseErrors:
    """RPE over ``delta`` metres along the estimated path, or seconds, as evo has it."""

    delta: float
    unit: Literal["m", "s"]
    pairs: Literal["consecutive", "all"]
    judged: JudgedErrors

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {"delta": self.delta, "unit": self.unit, "pairs": self.pairs, **self.judged.keys()}


def relative(pairs: PairedPoses) -> tuple[RelativePoseErrors, ...]:
    """Return the RPE over the usual distances, with consecutive (evo's default) and all pairs, and over the usual times.

    A distance or time without any pair is left out.
    """
    position_m = pairs.estimated[:, :3, 3]
    found = [
        RelativePoseErrors(
            delta_m,
            "m",
            "all" if all_pairs else "consecutive",
            _judged_motion(pairs, pairs_by_path(position_m, delta_m, all_pairs=all_pairs)),
        )
        for delta_m in RPE_DISTANCES_M
        for all_pairs in (False, True)
    ]
    found += [
        RelativePoseErrors(delta_s, "s", "all", _judged_motion(pairs, pairs_by_time(pairs.stamp_ns, delta_s)))
        for delta_s in RPE_TIMES_S
    ]
    return tuple(each for each in found if each.judged.errors.n)


def _judged_motion(pairs: PairedPoses, rows: NDArray[np.intp]) -> JudgedErrors:
    errors = relative_errors(pairs.estimated, pairs.reference, rows)
    return judged(pairs, errors, explained_motion(pairs, rows))


def explained_motion(pairs: PairedPoses, rows: NDArray[np.intp]) -> Explained:
    """Return the error of the motion over pairs of rows, (K, 2), that the reference's covariance predicts.

    Its common part cancels; the rest is taken to be independent at both ends, which is too much for motions shorter than the
    correlation time of the reference.
    """
    covariance, common = pairs.reference_covariance, pairs.reference_covariance_common
    if covariance is None or not len(rows):
        return Explained(math.nan, math.nan, math.nan, math.nan)
    own = covariance if common is None else covariance - common
    first, second = rows.T
    travelled = pairs.reference[second, :3, 3] - pairs.reference[first, :3, 3]
    # An error of the first rotation turns the whole motion; positions alone are given that rotation themselves.
    C, lever = own[first], skew(travelled if pairs.has_orientation else np.zeros_like(travelled))
    turned = lever @ C[:, 3:, :3]
    position = (
        _trace(C[:, :3, :3])
        - 2 * _trace(turned)
        + _trace(lever @ C[:, 3:, 3:] @ np.swapaxes(lever, 1, 2))
        + _trace(own[second, :3, :3])
    )
    rotation = _trace(C[:, 3:, 3:]) + _trace(own[second, 3:, 3:])
    rms_m, rms_rad = (math.sqrt(max(0.0, float(square.mean()))) for square in (position, rotation))
    return Explained(1e3 * rms_m, math.degrees(rms_rad), 0.0, 0.0)


def _trace(blocks: FloatArray) -> FloatArray:
    traces: FloatArray = np.einsum("nii->n", blocks)
    return traces


@dataclass(frozen=True, slots=True)
class SegmentErrors:
    """Mean errors over ``n`` segments of a length along the path of the reference, as in KITTI's odometry benchmark."""

    length_m: float
    n: int
    position_percent: float
    orientation_deg_per_m: float
    explained_percent: float  # by the reference's uncertainty, as root mean square

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {
            "length_m": self.length_m,
            "n": self.n,
            "position_percent": self.position_percent,
            "orientation_deg_per_m": self.orientation_deg_per_m,
            "explained_percent": self.explained_percent,
        }


@dataclass(frozen=True, slots=True)
class Drift:
    """Errors over segments, and their mean over all segments of all lengths: drift per metre. NaN without any.

    ``shortened``: the path is too short for KITTI's lengths, and shorter ones are used. ``curve``: over more lengths, with at
    least :data:`MIN_SEGMENTS` each.
    """

    shortened: bool
    segments: tuple[SegmentErrors, ...]
    position_mm_per_m: float
    orientation_deg_per_m: float
    curve: tuple[SegmentErrors, ...]

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {
            "position_mm_per_m": self.position_mm_per_m,
            "orientation_deg_per_m": self.orientation_deg_per_m,
            "shortened": self.shortened,
            "segments": [each.keys() for each in self.segments],
        }


def drift(pairs: PairedPoses) -> Drift:
    """Return KITTI's errors: a segment starts each second and ends where the reference has driven further than its length.

    Source: Geiger et al. 2012, Are we ready for autonomous driving?, and evaluate_odometry.cpp of its development kit.
    """
    steps_m = np.linalg.norm(np.diff(pairs.reference[:, :3, 3], axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps_m)])[: len(pairs.stamp_ns)]
    driven_m = float(path_m[-1]) if len(path_m) else 0.0
    scale = 1.0
    while scale > 1e-2 and driven_m < MIN_KITTI_PATH_M * scale:
        scale /= 10.0
    rows = {length_m: _segments(pairs, path_m, length_m) for length_m in _CURVE_LENGTHS_M}
    lengths_m = [length_m * scale for length_m in KITTI_LENGTHS_M]
    found = [_segment_errors(pairs, length_m, _segments(pairs, path_m, length_m)) for length_m in lengths_m]
    found = [each for each in found if each.n]
    count = sum(each.n for each in found)
    percent = sum(each.n * each.position_percent for each in found) / count if count else math.nan
    turn = sum(each.n * each.orientation_deg_per_m for each in found) / count if count else math.nan
    return Drift(
        shortened=scale < 1.0,
        segments=tuple(found),
        position_mm_per_m=10.0 * percent,
        orientation_deg_per_m=turn,
        curve=tuple(
            _segment_errors(pairs, length_m, some)
            for length_m, some in rows.items()
            if len(some) >= MIN_SEGMENTS
        ),
    )


def _segments(pairs: PairedPoses, path_m: FloatArray, length_m: float) -> NDArray[np.intp]:
    """Return first and last row of each segment, (K, 2)."""
    if not len(path_m):
        return np.empty((0, 2), np.intp)
    time_s = (pairs.stamp_ns - pairs.stamp_ns[0]) / 1e9
    starts = np.flatnonzero(np.diff(np.floor((time_s + 1e-6) / START_SPACING_S), prepend=-1.0))
    ends = np.searchsorted(path_m, path_m[starts] + length_m, side="right")
    inside = ends < len(path_m)
    return np.stack([starts[inside], ends[inside]], axis=1).astype(np.intp)


def _segment_errors(pairs: PairedPoses, length_m: float, rows: NDArray[np.intp]) -> SegmentErrors:
    if not len(rows):
        return SegmentErrors(length_m, 0, math.nan, math.nan, math.nan)
    first, second = rows.T
    motion, true = (invert(T[first]) @ T[second] for T in (pairs.estimated, pairs.reference))
    error = invert(true) @ motion
    angle_rad = (
        float(np.linalg.norm(log_so3(error[:, :3, :3]), axis=1).mean()) if pairs.has_orientation else math.nan
    )
    return SegmentErrors(
        length_m,
        len(rows),
        100.0 * float(np.linalg.norm(error[:, :3, 3], axis=1).mean()) / length_m,
        math.degrees(angle_rad) / length_m,
        0.1 * explained_motion(pairs, rows).position_rms_mm / length_m,
    )
