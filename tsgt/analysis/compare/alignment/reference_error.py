"""Errors of the reference in a fit: more of them where its covariance is larger, and in rotation and position at once.

Poses of a smoother are conditional means: their errors are independent of these poses, not of the true motion, of which the
smoother takes off what it cannot tell from noise (errors of Berkson's kind). So the errors make residuals larger, over the lever
arm too, but bias no lever arm: derivatives are taken at the reference as it is. A correction for errors in variables, as for
poses that are the truth plus noise, would place sensors away from the prisms' centroid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import skew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.interpolation import ReferenceTrajectory
    from tsgt.geometry import FloatArray

CORRELATION_WIDTH_S = 0.2
"""Errors of a processed trajectory are correlated as white noise under a Gaussian kernel of this width, by exp(-lag² / (2 width)²): measured
on simulated missions with three prisms at 2.5 Hz, rotation 0.81 over 0.2 s, 0.18 over 0.5 s; position 0.73 and 0.04."""

WHITE_EQUIVALENT_S = 2.0 * math.sqrt(math.pi) * CORRELATION_WIDTH_S
"""Interval at which white noise of the same variance has the same power at the low frequencies at which robots move."""

UNKNOWN_ROTATION = 1e4  # Variance in rad^2 of the rotation of positions alone


@dataclass(frozen=True, slots=True)
class Whitening:
    """What makes residuals of unit covariance."""

    matrix: FloatArray  # (N, 6, 6)
    square: FloatArray  # (N,) squared Mahalanobis distance of the residual


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


def change_variance(lag_s: float) -> float:
    """Variance of the change of a reference's error over a lag, in units of the error's own."""
    return 2.0 * (1.0 - math.exp(-((0.5 * lag_s / CORRELATION_WIDTH_S) ** 2)))


def as_white(covariance: FloatArray, step_s: float) -> FloatArray:
    """Return the covariance, (N, 6, 6), of white noise at these steps, in s, with the power of the correlated errors where robots move."""
    return covariance * max(1.0, WHITE_EQUIVALENT_S / step_s)


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
        return Whitening(matrix, (scaled**2).sum(axis=1))
    total = at_sensor(covariance, arm_m)
    total[:, range(6), range(6)] += variance
    matrix = np.linalg.inv(np.linalg.cholesky(total))
    scaled = rotate_six(matrix, residual)
    return Whitening(matrix, (scaled**2).sum(axis=1))


def rotate_six(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Matrix-vector products, (N, 6)."""
    return np.asarray((matrix @ vector[:, :, None])[:, :, 0])
