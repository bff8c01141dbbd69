"""Quality of valid poses: good, or degraded and by what. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation.pose_batch import Degradation, Kind, Reason
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
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
