"""Errors of the reference in a fit: more of them where its covariance is larger, and in rotation and position at once.

A lever arm multiplies the reference's rotation. If the error of this rotation went into the fit as if it were motion, the fit would
prefer the lever arm at which the reference's own errors cancel: that of the prisms' centroid (errors in variables). So each pose
of the reference has an unknown error of its covariance, which is eliminated pose by pose (Gauss-Helmert model).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import skew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.interpolation import ReferenceTrajectory
    from tsgt.geometry import FloatArray

CORRELATION_S = 0.5
"""Correlation time of the errors of a processed trajectory: about the time between measurements of one prism."""

UNKNOWN_ROTATION = 1e4  # Variance in rad^2 of the rotation of positions alone


@dataclass(frozen=True, slots=True)
class Whitening:
    """What makes residuals of unit covariance, and the part of them that is the reference's error."""

    matrix: FloatArray  # (N, 6, 6)
    square: FloatArray  # (N,) squared Mahalanobis distance of the residual
    turn: FloatArray  # (N, 3) most likely rotation error of the reference, to be added to its rotation, about fixed axes


def own_covariance(
    trajectory: ReferenceTrajectory, stamp_ns: NDArray[np.int64], known: NDArray[np.bool_]
) -> FloatArray | None:
    """Covariance of the reference's point at N instants, (N, 6, 6), without what all poses share; None: unknown."""
    reference = trajectory.reference
    if reference.covariance is None:
        return None
    covariance = reference.covariance
    if reference.covariance_common is not None:
        covariance = covariance - reference.covariance_common
    found = np.zeros((len(stamp_ns), 6, 6))
    found[known] = trajectory.covariance_at(covariance, stamp_ns[known])
    diagonal = np.einsum("nii->ni", found)
    # A common part that was rounded, or interpolated, above the whole.
    diagonal[:] = np.maximum(diagonal, 0.0)
    return found


def at_sensor(covariance: FloatArray, arm_m: FloatArray) -> FloatArray:
    """Covariance of the residuals by that of the point, (N, 6, 6), over lever arms in ``station1``, (N, 3)."""
    by_error = np.tile(np.eye(6), (len(arm_m), 1, 1))
    by_error[:, :3, 3:] = -skew(arm_m)
    return np.asarray(by_error @ covariance @ np.swapaxes(by_error, 1, 2))


def whiten(
    residual: FloatArray,
    white: FloatArray,
    covariance: FloatArray | None,
    arm_m: FloatArray,
    *,
    has_orientation: bool,
) -> Whitening:
    """Whiten residuals, (N, 6) of estimate minus reference, by variances of the estimate, (6,), and of the reference, (N, 6, 6)."""
    n = len(residual)
    variance = white.copy()
    if not has_orientation:
        variance[3:] = UNKNOWN_ROTATION
    if covariance is None:
        scaled = residual / np.sqrt(variance)
        matrix = np.tile(np.diag(1.0 / np.sqrt(variance)), (n, 1, 1))
        return Whitening(matrix, (scaled**2).sum(axis=1), np.zeros((n, 3)))
    total = at_sensor(covariance, arm_m)
    total[:, range(6), range(6)] += variance
    matrix = np.linalg.inv(np.linalg.cholesky(total))
    scaled = rotate_six(matrix, residual)
    # Residual = estimate's error minus what the reference's error does at the sensor: its mean, given the residual.
    pull = rotate_six(np.swapaxes(matrix, 1, 2), scaled)
    at_point = pull.copy()
    at_point[:, 3:] += np.cross(arm_m, pull[:, :3])
    turn = rotate_six(covariance, at_point)[:, 3:]
    return Whitening(matrix, (scaled**2).sum(axis=1), turn)


def rotate_six(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Matrix-vector products, (N, 6)."""
    return np.asarray((matrix @ vector[:, :, None])[:, :, 0])
