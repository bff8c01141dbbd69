"""Errors of the poses of a stream by kind and by age, and what they promise: limits and covariance. Sans-I/O."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.evaluation.metrics import CentroidErrors, NeesStatistics, pose_errors
from tsgt.geometry import log_so3

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

AGE_EDGES_MS = (0, 100, 200, 300, 400, 600, 1000, 2000, 3000, 3250, 3500, 4000, math.inf)
"""Ages of predictions are fractions of a second, those of smoothed poses their delay, or the lag (3 s) and up to half a
second."""

THREE_SIGMA_3D = (
    14.156  # Squared Mahalanobis distance that 0.27 % of three-dimensional Gaussian errors exceed
)


@dataclass(frozen=True, slots=True)
class Shares:
    """Shares of the compared poses, 0 to 1; NaN without poses."""

    position: float
    rotation: float


@dataclass(frozen=True, slots=True)
class AgeBin:
    """Errors of the poses of an age from ``from_ms`` on and below ``to_ms``; positions at the reference point."""

    from_ms: float
    to_ms: float | None  # None: no upper limit
    compared: int
    position_rms_mm: float
    position_median_mm: float
    position_p95_mm: float
    orientation_rms_deg: float
    nees_mean: float


@dataclass(frozen=True, slots=True)
class LivePoseStatistics:
    """Errors of ``compared`` valid poses at the reference point, and how they keep what they promise; NaN without poses.

    Attributes
    ----------
    beyond_limits
        Poses whose error is larger than the limit of the sigma.
    beyond_3_sigma
        Poses whose error is beyond 3 sigmas of their own covariance: 0.0027 if it is right.
    """

    compared: int
    position_rms_mm: float
    position_median_mm: float
    position_p95_mm: float
    orientation_rms_deg: float
    orientation_median_deg: float
    orientation_p95_deg: float
    centroid: CentroidErrors
    beyond_limits: Shares
    beyond_3_sigma: Shares
    nees: NeesStatistics
    by_age: tuple[AgeBin, ...]


@dataclass(frozen=True, slots=True)
class LivePoseErrors:
    """Errors of N valid poses of a stream."""

    age_s: NDArray[
        np.float64
    ]  # (N,) predicted: of the newest measurement at the stamp; others: of the pose when sent
    position_m: NDArray[np.float64]  # (N,) norm of the position error at the reference point
    centroid_m: NDArray[np.float64]  # (N,) at the prisms' centroid
    rotation_rad: NDArray[np.float64]  # (N,) angle of the rotation error
    nees: NDArray[np.float64]  # (N,) of position and rotation
    position_nees: NDArray[np.float64]  # (N,) of the position alone
    rotation_nees: NDArray[np.float64]  # (N,) of the rotation alone

    @classmethod
    def of(
        cls,
        estimated: FloatArray,
        covariance: FloatArray,
        age_s: NDArray[np.float64],
        true: FloatArray,
        centroid_m: FloatArray,
    ) -> LivePoseErrors:
        """Compare poses, (N, 4, 4), as :func:`~tsgt.analysis.evaluation.metrics.pose_errors` does; ``covariance``: (N, 6, 6)."""
        errors = pose_errors(estimated, true, centroid_m)
        rotation = log_so3(estimated[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2))
        six = np.concatenate([estimated[:, :3, 3] - true[:, :3, 3], rotation], axis=1)
        return cls(
            age_s=age_s,
            position_m=errors.position_m,
            centroid_m=errors.centroid_m,
            rotation_rad=errors.rotation_rad,
            nees=_squared_distances(six, covariance),
            position_nees=_squared_distances(six[:, :3], covariance[:, :3, :3]),
            rotation_nees=_squared_distances(six[:, 3:], covariance[:, 3:, 3:]),
        )

    @classmethod
    def concatenated(cls, parts: Sequence[LivePoseErrors]) -> LivePoseErrors:
        """Concatenate errors."""
        return cls(
            *(
                np.concatenate([np.empty(0), *(getattr(part, field.name) for part in parts)])
                for field in dataclasses.fields(cls)
            )
        )

    def select(self, rows: NDArray[np.bool_]) -> LivePoseErrors:
        """Return the errors of a mask."""
        return LivePoseErrors(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    def statistics(self, limit_m: float | None, limit_rad: float | None) -> LivePoseStatistics:
        """Summarise; the limits are those of the sigmas of a valid pose, None without."""
        position = _Summary.of(1e3 * self.position_m)
        rotation = _Summary.of(np.degrees(self.rotation_rad))
        ages_ms = 1e3 * self.age_s
        bins = []
        for from_ms, to_ms in itertools.pairwise(AGE_EDGES_MS):
            rows = (ages_ms >= from_ms) & (ages_ms < to_ms)
            if rows.any():
                some = _Summary.of(1e3 * self.position_m[rows])
                bins.append(
                    AgeBin(
                        from_ms=from_ms,
                        to_ms=to_ms if math.isfinite(to_ms) else None,
                        compared=int(np.count_nonzero(rows)),
                        position_rms_mm=some.rms,
                        position_median_mm=some.median,
                        position_p95_mm=some.p95,
                        orientation_rms_deg=_Summary.of(np.degrees(self.rotation_rad[rows])).rms,
                        nees_mean=float(self.nees[rows].mean()),
                    )
                )
        return LivePoseStatistics(
            compared=len(self.age_s),
            position_rms_mm=position.rms,
            position_median_mm=position.median,
            position_p95_mm=position.p95,
            orientation_rms_deg=rotation.rms,
            orientation_median_deg=rotation.median,
            orientation_p95_deg=rotation.p95,
            centroid=CentroidErrors(_Summary.of(1e3 * self.centroid_m).rms),
            beyond_limits=Shares(_share(self.position_m, limit_m), _share(self.rotation_rad, limit_rad)),
            beyond_3_sigma=Shares(
                _share(self.position_nees, THREE_SIGMA_3D), _share(self.rotation_nees, THREE_SIGMA_3D)
            ),
            nees=NeesStatistics.of_squares(self.nees),
            by_age=tuple(bins),
        )


@dataclass(frozen=True, slots=True)
class LivePoses:
    """How good the poses of one kind are."""

    poses: int  # valid or not
    valid_poses: int
    age_s: NDArray[np.float64]  # (valid_poses,) NaN where unknown
    errors: LivePoseStatistics

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        known = 1e3 * self.age_s[np.isfinite(self.age_s)]
        p50, p99 = np.percentile(known, [50, 99]).tolist() if len(known) else (math.nan, math.nan)
        return {
            "poses": self.poses,
            "valid_poses": self.valid_poses,
            "valid_fraction": self.valid_poses / self.poses if self.poses else math.nan,
            "age_ms": {"p50": p50, "p99": p99},
            **dataclasses.asdict(self.errors),
        }


@dataclass(frozen=True, slots=True)
class _Summary:
    rms: float
    median: float
    p95: float

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> _Summary:
        if not len(values):
            return cls(math.nan, math.nan, math.nan)
        median, p95 = np.percentile(values, [50, 95]).tolist()
        return cls(math.sqrt(float(np.mean(values**2))), median, p95)


def _share(values: NDArray[np.float64], limit: float | None) -> float:
    return float(np.mean(values > limit)) if limit is not None and len(values) else math.nan


def _squared_distances(errors: FloatArray, covariance: FloatArray) -> NDArray[np.float64]:
    if not len(errors):
        return np.empty(0)
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0]))
