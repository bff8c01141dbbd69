"""Pose errors against the truth, unaligned and after an alignment. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from tsgt.geometry import align, invert, log_so3, transform_from, transform_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

EDGE_MARGIN_NS = 2_000_000_000  # Excluded at both ends: the estimator has measurements on one side only


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of N poses."""

    position_m: NDArray[np.float64]  # (N,) norm of the position error at the reference point
    centroid_m: NDArray[np.float64]  # (N,) at the prisms' centroid
    rotation_rad: NDArray[np.float64]  # (N,) angle of the rotation error

    @property
    def position_rms_mm(self) -> float:
        """Root mean square of the position error at the reference point; NaN without poses."""
        return 1e3 * _rms(self.position_m)

    @property
    def centroid(self) -> CentroidErrors:
        """Root mean square of the position error at the prisms' centroid; NaN without poses."""
        return CentroidErrors(1e3 * _rms(self.centroid_m))

    @property
    def orientation_rms_deg(self) -> float:
        """Root mean square of the rotation error; NaN without poses."""
        return math.degrees(_rms(self.rotation_rad))


@dataclass(frozen=True, slots=True)
class CentroidErrors:
    """Root mean square of the position error at the prisms' centroid; NaN without poses."""

    position_rms_mm: float


NEES_95 = {
    3: 7.814728,
    6: 12.591587,
}  # 95th percentiles of the chi-square distribution, by degrees of freedom


@dataclass(frozen=True, slots=True)
class NeesStatistics:
    """Normalised estimation error squared (NEES) of position and rotation, or of positions alone; NaN without poses.

    Consistent covariances have mean 6, or 3 (overconfident: larger), and a share of 0.05 above :data:`NEES_95`. Source:
    Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, section 5.4.2.
    """

    mean: float
    above_95: float
    max: float

    @classmethod
    def of(cls, errors: NDArray[np.float64], covariance: NDArray[np.float64]) -> NeesStatistics:
        """Compute the NEES of errors, (N, D), with covariances, (N, D, D); D is 6 or 3."""
        squares = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0])
        return cls.of_squares(squares, degrees_of_freedom=errors.shape[1])

    @classmethod
    def of_squares(cls, nees: NDArray[np.float64], *, degrees_of_freedom: int = 6) -> NeesStatistics:
        """Summarise the NEES of N poses, (N,)."""
        if not len(nees):
            return cls(math.nan, math.nan, math.nan)
        limit = NEES_95[degrees_of_freedom]
        return cls(mean=float(nees.mean()), above_95=float(np.mean(nees > limit)), max=float(nees.max()))


@dataclass(frozen=True, slots=True)
class PoseErrorStatistics:
    """Unaligned errors of ``compared`` poses as root mean squares, at the reference point; NaN without poses."""

    compared: int
    position_rms_mm: float
    orientation_rms_deg: float
    centroid: CentroidErrors
    nees: NeesStatistics

    @classmethod
    def of(
        cls,
        estimated: NDArray[np.float64],
        covariance: NDArray[np.float64],
        true: NDArray[np.float64],
        centroid_m: NDArray[np.float64],
    ) -> PoseErrorStatistics:
        """Compare as :func:`pose_errors` does; ``covariance``: (N, 6, 6) of ``estimated``, rotations about the world's axes."""
        errors = pose_errors(estimated, true, centroid_m)
        rotation = log_so3(estimated[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2))
        return cls(
            compared=len(estimated),
            position_rms_mm=errors.position_rms_mm,
            orientation_rms_deg=errors.orientation_rms_deg,
            centroid=errors.centroid,
            nees=NeesStatistics.of(
                np.concatenate([estimated[:, :3, 3] - true[:, :3, 3], rotation], axis=1), covariance
            ),
        )


def pose_errors(
    estimated: NDArray[np.float64], true: NDArray[np.float64], centroid_m: NDArray[np.float64]
) -> PoseErrors:
    """Compare poses ``T_station1_point``, (N, 4, 4), with the truth at the same instants, without alignment.

    ``centroid_m``: the prisms' centroid in the frame of the point, (3,).
    """
    at_centroid = transform_points(estimated, centroid_m) - transform_points(true, centroid_m)
    rotation = (invert(true) @ estimated)[:, :3, :3]
    return PoseErrors(
        np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1),
        np.linalg.norm(at_centroid, axis=1),
        np.linalg.norm(log_so3(rotation), axis=1),
    )


def interior_mask(stamp_ns: NDArray[np.int64], start_ns: int, end_ns: int) -> NDArray[np.bool_]:
    """Return, (N,), which instants are at least :data:`EDGE_MARGIN_NS` after the start and before the end."""
    inner: NDArray[np.bool_] = (stamp_ns >= start_ns + EDGE_MARGIN_NS) & (stamp_ns <= end_ns - EDGE_MARGIN_NS)
    return inner


def _rms(values: NDArray[np.float64]) -> float:
    return math.sqrt(float(np.mean(values**2))) if len(values) else math.nan


Align = Literal["translation", "rigid"]


@dataclass(frozen=True, slots=True)
class AlignedErrorStatistics:
    """Errors left after aligning poses with a reference by one transform, and what the alignment hides.

    Attributes
    ----------
    translation_mm : Shift of the mean of the compared positions, of the reference point.
    rotation_deg : Rotation of the alignment; 0 with ``translation``.
    position_rms_mm, orientation_rms_deg : Root mean squares after the alignment, at the reference point.
    centroid : The same at the prisms' centroid.
    hidden_position_mm, hidden_orientation_deg
        Root mean squares before minus after. The orientation may be negative, since only positions are aligned.
    """

    translation_mm: float
    rotation_deg: float
    position_rms_mm: float
    orientation_rms_deg: float
    centroid: CentroidErrors
    hidden_position_mm: float
    hidden_orientation_deg: float


def aligned_statistics(
    estimated: FloatArray, true: FloatArray, centroid_m: FloatArray, mode: Align
) -> AlignedErrorStatistics:
    """Align the positions of poses with the truth, and compare; arguments as for :func:`pose_errors`.

    ``translation``: shift only. ``rigid``: shift and rotation without scale (Umeyama 1991), as evo's ``-a``; it raises
    DegenerateGeometryError if the positions lie in a line or coincide, or there are fewer than three.
    """
    before = pose_errors(estimated, true, centroid_m)
    points, true_points = estimated[:, :3, 3], true[:, :3, 3]
    if not len(estimated):
        return AlignedErrorStatistics(*(math.nan,) * 4, before.centroid, math.nan, math.nan)
    rotation = align(points, true_points).rotation if mode == "rigid" else np.eye(3)
    shift = true_points.mean(axis=0) - points.mean(axis=0)
    aligned = transform_from(rotation, true_points.mean(axis=0) - rotation @ points.mean(axis=0)) @ estimated
    after = pose_errors(aligned, true, centroid_m)
    return AlignedErrorStatistics(
        translation_mm=1e3 * float(np.linalg.norm(shift)),
        rotation_deg=math.degrees(float(np.linalg.norm(log_so3(rotation)))),
        position_rms_mm=after.position_rms_mm,
        orientation_rms_deg=after.orientation_rms_deg,
        centroid=after.centroid,
        hidden_position_mm=before.position_rms_mm - after.position_rms_mm,
        hidden_orientation_deg=before.orientation_rms_deg - after.orientation_rms_deg,
    )
