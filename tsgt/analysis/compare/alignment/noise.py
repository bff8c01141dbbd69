"""Error level of an estimate from its residuals: white noise, and drift with time and with the driven path.

From medians of squared differences over several lags (a variogram): what an estimate has lost track of counts as outliers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import nnls

from tsgt.analysis.compare.alignment.drifting_frame import Noise, drift_at
from tsgt.analysis.compare.alignment.reference_error import at_sensor, change_variance, own_covariance
from tsgt.geometry import log_so3, rotate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.alignment.drifting_frame import Rows, Unknowns
    from tsgt.analysis.compare.interpolation import ReferenceTrajectory
    from tsgt.geometry import FloatArray

LAGS_S = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # The first: from row to row
MEDIAN_OF_CHI_SQUARE = 0.454936
MIN_PAIRS = 12
MAX_WEIGHT = 100.0
ROUGH_LAG_S = 1.0
MIN_WHITE_SHARE = 0.1  # Of the squared differences from row to row
MIN_SHARE = 0.1  # Of the squared differences, that is the estimate's however large the reference says that its errors are

WHITE_FLOOR = np.array([1e-5] * 3 + [1e-6] * 3) ** 2
MIN_WALK = 1e-3  # Per second, of the white variance: less drift than a sigma in ten minutes would not show
FIXED_ROTATION_WALK = (
    1e-4**2
)  # Of a frame of positions alone, in rad^2 per second: 0.1 degrees in five minutes


def estimate_noise(
    trajectory: ReferenceTrajectory,
    rows: Rows,
    unknowns: Unknowns,
    lost: NDArray[np.bool_],
    *,
    is_rough: bool = False,
) -> Noise:
    """Return the variances of white noise and drift at the present relation.

    ``lost``: (K - 1,) intervals over which the estimate has lost track; no difference spans them.
    ``is_rough``: the relation is far from right. What it does wrong is smooth, its squared differences grow with the square of
    short lags: they are told from those of noise and of drift.
    """
    correction_ns = 1e9 * (unknowns.offset_s + unknowns.skew * rows.since_first_s)
    stamp_ns = rows.stamp_ns + np.rint(correction_ns).astype(np.int64)
    motion = trajectory.motion_at(stamp_ns)
    Q, _, _, _ = drift_at(rows, unknowns)
    own = unknowns.scale * rows.position_m
    # The path by the estimate's own steps, turned as the frame is: differences from the reference drift, and are noisy.
    steps = 0.5 * (rotate(Q[:-1], np.diff(own, axis=0)) + rotate(Q[1:], np.diff(own, axis=0)))
    composed = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    position = composed - motion.position_m - rotate(motion.rotation, unknowns.arm_m)
    turned = None
    if rows.rotation is not None:
        turned = motion.rotation @ unknowns.R_point_sensor @ np.swapaxes(rows.rotation, 1, 2)
    driven_m = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(own[rows.knot], axis=0) ** 2).sum(axis=1)))])
    driven_m = driven_m[rows.interval] + rows.share * np.diff(driven_m)[rows.interval]
    span_s = float(rows.since_first_s[-1] - rows.since_first_s[0])
    of_reference = own_covariance(trajectory, stamp_ns, motion.known)
    usual = np.zeros(6)
    if of_reference is not None and motion.known.any():
        arm_m = rotate(motion.rotation, unknowns.arm_m)
        usual = np.median(np.einsum("nii->ni", at_sensor(of_reference, arm_m))[motion.known], axis=0)
    terms, squares, weights = [], [], []
    max_lag_s = ROUGH_LAG_S if is_rough else 0.2 * span_s
    for lag_s in (each for each in LAGS_S if each <= max_lag_s):
        before, after = _pairs(rows, lag_s, motion.known, lost)
        difference = np.zeros((len(before), 6))
        difference[:, :3] = position[after] - position[before]
        if turned is not None:
            difference[:, 3:] = log_so3(turned[after] @ np.swapaxes(turned[before], 1, 2))
        step_s, step_m = (
            rows.since_first_s[after] - rows.since_first_s[before],
            driven_m[after] - driven_m[before],
        )
        for some in _halves(step_m):
            if np.count_nonzero(some) >= MIN_PAIRS:
                # A long lag has few intervals that do not overlap.
                weights.append(math.sqrt(min(span_s / max(lag_s, 0.5), MAX_WEIGHT)))
                smooth = (step_s[some] ** 2).mean() if is_rough else 0.0
                terms.append((2.0, step_s[some].mean(), step_m[some].mean(), smooth))
                square = np.median(difference[some] ** 2, axis=0) / MEDIAN_OF_CHI_SQUARE
                share = usual * change_variance(float(step_s[some].mean()))
                squares.append(np.maximum(square - share, MIN_SHARE * square))
    if len(terms) < 4:
        return Noise(
            np.array([0.01] * 3 + [0.002] * 3) ** 2, np.array([0.01] * 3 + [0.001] * 3) ** 2, np.zeros(6)
        )
    parts = np.stack(
        [_variances(np.array(terms), column, np.array(weights)) for column in np.array(squares).T]
    )
    least = MIN_WHITE_SHARE * 0.5 * np.mean(squares[:2], axis=0)
    white = np.maximum(parts[:, 0], np.maximum(least, WHITE_FLOOR))
    walk_per_s = np.maximum(parts[:, 1], MIN_WALK * white)
    if turned is None:
        walk_per_s[3:] = FIXED_ROTATION_WALK
    return Noise(white, walk_per_s, parts[:, 2])


def _pairs(
    rows: Rows, lag_s: float, known: NDArray[np.bool_], lost: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    before = np.arange(len(rows.row) - 1)
    after = np.maximum(
        np.searchsorted(rows.since_first_s, rows.since_first_s[:-1] + lag_s - 1e-3), before + 1
    )
    inside = after < len(rows.row)
    before, after = before[inside], after[inside]
    step_s = rows.since_first_s[after] - rows.since_first_s[before]
    near = (step_s <= 1.5 * max(lag_s, float(np.median(step_s)))) & known[before] & known[after]
    count = np.concatenate([[0], np.cumsum(lost)])
    near &= count[rows.interval[after] + 1] == count[rows.interval[before]]
    return before[near], after[near]


def _halves(step_m: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    middle_m = float(np.median(step_m)) if len(step_m) else 0.0
    return np.less_equal(step_m, middle_m), np.greater(step_m, middle_m)


def _variances(terms: FloatArray, squares: FloatArray, weight: FloatArray) -> FloatArray:
    """Non-negative variances, (4,), of which the terms, (L, 4), make up the squares, (L,); relative errors count."""
    expected = np.maximum(squares, 1e-20)
    found = np.zeros(terms.shape[1])
    for _ in range(3):
        found, _ = nnls(terms * (weight / expected)[:, None], squares * weight / expected)
        fitted = terms @ found
        expected = np.maximum(fitted, 1e-3 * fitted.max() + 1e-20)
    return found
