"""Quality of valid poses: good, or degraded and by what. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation.pose_batch import Degradation, Kind, Reason
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.estimation.pose_batch import PoseBatch
    from tsgt.model import PipelineParameters

DEGRADED_SHARE = 0.5
"""Share of a limit above which a pose is degraded: a sigma that doubles, as in half a second without measurements, makes it
invalid.
"""

OLD_SHARE = 0.75
"""Share of the outage limit. With measurements of three prisms in each frame of the radio, 99 of 100 predictions rest on one
that is less than 0.62 s old."""

_VALID = int(Reason.VALID)
# Plain numbers: operators of flags take microseconds
_PRISM_MISSING, _OLD_MEASUREMENTS, _UNCERTAIN, _AMBIGUOUS, _RESIDUAL = (
    int(each)
    for each in (
        Degradation.PRISM_MISSING,
        Degradation.OLD_MEASUREMENTS,
        Degradation.UNCERTAIN,
        Degradation.AMBIGUOUS,
        Degradation.RESIDUAL,
    )
)


def worst_sigma(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sigmas, (N,), along the least certain direction; NaN where a covariance, (N, 3, 3), is NaN or negative."""
    known = np.isfinite(covariance).all(axis=(1, 2))
    variance = np.full(len(covariance), np.nan)
    variance[known] = np.linalg.eigvalsh(covariance[known])[:, -1]
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def sigma_limits(kind: NDArray[np.int8], limits: PipelineParameters) -> NDArray[np.float64]:
    """Return the limits of both sigmas, (N, 2) in m and rad; those of predictions differ, interpolated poses have none."""
    found = np.array(
        [
            (np.inf, np.inf),
            (limits.predicted_position_sigma_limit_m, limits.predicted_rotation_sigma_limit_rad),
            (limits.position_sigma_limit_m, limits.rotation_sigma_limit_rad),
        ]
    )
    return np.asarray(found[kind])


def sigma_limits_of(series: str, limits: PipelineParameters) -> tuple[float | None, float | None]:
    """Return the limits of the sigmas of valid poses of a series, in m and rad; None where there are none."""
    kind, _, _ = series.partition("_")
    if kind == "interpolated":
        return None, None
    limit_m, limit_rad = sigma_limits(np.array([Kind[kind.upper()]], np.int8), limits)[0].tolist()
    return limit_m, limit_rad


def degradations(
    batch: PoseBatch,
    sigmas: NDArray[np.float64],
    limits: PipelineParameters,
    *,
    ambiguous: NDArray[np.bool_] | None = None,
) -> NDArray[np.int8]:
    """Return what degrades each valid pose, (N,) values of :class:`Degradation`; 0 for good and for invalid ones.

    Parameters
    ----------
    sigmas
        (N, 2) position and rotation sigma in the least certain direction, in m and rad.
    ambiguous
        (N,) whether the state was ambiguous shortly before. Default: nowhere.
    """
    found = np.zeros(len(batch), np.int8)
    seen = np.count_nonzero(batch.prism_reason == Reason.VALID, axis=1)
    # A layout of one or two prisms, which needs an IMU, has no more to miss.
    found[seen < min(MIN_PRISMS, batch.prism_reason.shape[1])] |= Degradation.PRISM_MISSING
    # NaN, for a prism that was never measured, is above no limit: it is missing.
    newest_age_s = np.fmin.reduce(batch.age_s, axis=1)
    old = newest_age_s > OLD_SHARE * limits.outage_limit_ns / 1e9
    found[old & (batch.kind == Kind.PREDICTED)] |= Degradation.OLD_MEASUREMENTS
    found[(sigmas > DEGRADED_SHARE * sigma_limits(batch.kind, limits)).any(axis=1)] |= Degradation.UNCERTAIN
    if ambiguous is not None:
        found[ambiguous] |= Degradation.AMBIGUOUS
    found[batch.residual_m > DEGRADED_SHARE * limits.residual_limit_m] |= Degradation.RESIDUAL
    found[~batch.valid] = 0
    return found


def degradation_of_one(
    kind: Kind,
    ages_s: Sequence[float],
    prism_reasons: Sequence[int],
    residual_m: float,
    sigmas: Sequence[float],
    sigma_limits_of_kind: Sequence[float],
    limits: PipelineParameters,
    *,
    ambiguous: bool,
) -> int:
    """Return what degrades one valid pose, as :func:`degradations`: for a single pose in a tenth of its time.

    ``ages_s``, ``prism_reasons``: by prism. ``sigmas``, ``sigma_limits_of_kind``: of position and rotation, in m and rad.
    """
    found = 0
    if prism_reasons.count(_VALID) < min(MIN_PRISMS, len(prism_reasons)):
        found |= _PRISM_MISSING
    newest_age_s = min((each for each in ages_s if not math.isnan(each)), default=math.nan)
    if kind == Kind.PREDICTED and newest_age_s > OLD_SHARE * limits.outage_limit_ns / 1e9:
        found |= _OLD_MEASUREMENTS
    if any(sigma > DEGRADED_SHARE * limit for sigma, limit in zip(sigmas, sigma_limits_of_kind, strict=True)):
        found |= _UNCERTAIN
    if ambiguous:
        found |= _AMBIGUOUS
    if residual_m > DEGRADED_SHARE * limits.residual_limit_m:
        found |= _RESIDUAL
    return found
