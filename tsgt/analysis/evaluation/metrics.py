"""How far poses are from the truth: unaligned, root mean squares over the inner part of a run.

What aligning poses with a reference would hide: errors before and after it. Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from tsgt.geometry import align, invert, log_so3, transform_from, transform_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

EDGE_NS = 2_000_000_000
"""What is left out at the start and at the end of a run, where an estimator lacks one of its sides."""


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of N poses.

    Attributes
    ----------
    position_m
        (N,) length of the position error at the chosen point of the robot, in m.
    rotation_rad
        (N,) angle of the rotation between estimate and truth, in rad.
    """

    position_m: NDArray[np.float64]
    rotation_rad: NDArray[np.float64]

    @property
    def position_rms_mm(self) -> float:
        """Root mean square of the position error in mm; NaN without poses."""
        return 1e3 * _rms(self.position_m)

    @property
    def orientation_rms_deg(self) -> float:
        """Root mean square of the rotation error in degrees; NaN without poses."""
        return math.degrees(_rms(self.rotation_rad))


NEES_95 = 12.591587
"""95th percentile of chi-square with 6 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class NeesStatistics:
    """Normalised estimation error squared, of position and rotation together; NaN without poses.

    Attributes
    ----------
    mean
        6 where the covariances are right; above that they promise too much.
    above_95
        Which share is above what 5 % of right ones are above.
    max
        The largest one.
    """

    mean: float
    above_95: float
    max: float

    @classmethod
    def of(cls, errors: NDArray[np.float64], covariance: NDArray[np.float64]) -> NeesStatistics:
        """Weigh errors, (N, 6), with their covariances, (N, 6, 6)."""
        if not len(errors):
            return cls(math.nan, math.nan, math.nan)
        nees = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0])
        return cls(mean=float(nees.mean()), above_95=float(np.mean(nees > NEES_95)), max=float(nees.max()))


@dataclass(frozen=True, slots=True)
class PoseErrorStatistics:
    """How far poses are from the truth; NaN where none could be compared.

    Attributes
    ----------
    compared
        How many there are.
    position_rms_mm, orientation_rms_deg
        Root mean squares, unaligned.
    nees
        Whether the errors are as large as the covariances say.
    """

    compared: int
    position_rms_mm: float
    orientation_rms_deg: float
    nees: NeesStatistics

    @classmethod
    def of(
        cls,
        estimated: NDArray[np.float64],
        covariance: NDArray[np.float64],
        true: NDArray[np.float64],
        point_m: NDArray[np.float64],
    ) -> PoseErrorStatistics:
        """Compare poses with the truth at the same instants.

        Parameters
        ----------
        estimated, true, point_m
            As for :func:`pose_errors`.
        covariance
            (N, 6, 6) of the estimated ones, rotations about fixed axes.
        """
        errors = pose_errors(estimated, true, point_m)
        turned = log_so3(estimated[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2))
        return cls(
            compared=len(estimated),
            position_rms_mm=errors.position_rms_mm,
            orientation_rms_deg=errors.orientation_rms_deg,
            nees=NeesStatistics.of(
                np.concatenate([estimated[:, :3, 3] - true[:, :3, 3], turned], axis=1), covariance
            ),
        )


def pose_errors(
    estimated: NDArray[np.float64], true: NDArray[np.float64], point_m: NDArray[np.float64]
) -> PoseErrors:
    """Compare poses with the truth at the same instants, without any alignment.

    Parameters
    ----------
    estimated, true
        ``T_station1_robot``, (N, 4, 4) each.
    point_m
        The point of the robot whose position is compared, in the frame ``robot``, (3,): the centroid of the
        prisms, which is where the stations measure.
    """
    offset = transform_points(estimated, point_m) - transform_points(true, point_m)
    turned = (invert(true) @ estimated)[:, :3, :3]
    return PoseErrors(
        position_m=np.linalg.norm(offset, axis=1), rotation_rad=np.linalg.norm(log_so3(turned), axis=1)
    )


def interior_mask(stamp_ns: NDArray[np.int64], start_ns: int, end_ns: int) -> NDArray[np.bool_]:
    """Tell, (N,), which instants count in a run's figures: those :data:`EDGE_NS` away from its start and end."""
    inner: NDArray[np.bool_] = (stamp_ns >= start_ns + EDGE_NS) & (stamp_ns <= end_ns - EDGE_NS)
    return inner


def _rms(values: NDArray[np.float64]) -> float:
    return math.sqrt(float(np.mean(values**2))) if len(values) else math.nan


Align = Literal["translation", "rigid"]


@dataclass(frozen=True, slots=True)
class AlignedErrorStatistics:
    """How far poses are from a reference when they have been brought as close to it as one transform can.

    Attributes
    ----------
    translation_mm
        By how much the middle of the compared positions was shifted.
    rotation_deg
        By how much all of it was turned; 0 where only a shift was allowed.
    position_rms_mm, orientation_rms_deg
        Root mean squares of what is left.
    hidden_position_mm, hidden_orientation_deg
        Root mean squares before less those after: what an aligned figure does not show. The orientation may be worse
        after, since only positions are aligned.
    """

    translation_mm: float
    rotation_deg: float
    position_rms_mm: float
    orientation_rms_deg: float
    hidden_position_mm: float
    hidden_orientation_deg: float


def aligned_statistics(
    estimated: FloatArray, true: FloatArray, point_m: FloatArray, mode: Align
) -> AlignedErrorStatistics:
    """Align poses with the truth at the same instants, and compare.

    Parameters
    ----------
    estimated, true
        ``T_station1_robot``, (N, 4, 4) each.
    point_m
        The point of the robot whose positions are aligned and compared, in the frame ``robot``, (3,).
    mode
        ``translation``: one shift for all poses. ``rigid``: a shift and a rotation, never a scale; what evo's ``-a`` does
        with the trajectories of this point (Umeyama 1991).

    Raises
    ------
    DegenerateGeometryError
        ``rigid``, and the positions lie in a line or at one place, or there are fewer than three.
    """
    before = pose_errors(estimated, true, point_m)
    found, wanted = transform_points(estimated, point_m), transform_points(true, point_m)
    if not len(estimated):
        return AlignedErrorStatistics(*(math.nan,) * 6)
    rotation = align(found, wanted).rotation if mode == "rigid" else np.eye(3)
    shift = wanted.mean(axis=0) - found.mean(axis=0)
    moved = transform_from(rotation, wanted.mean(axis=0) - rotation @ found.mean(axis=0)) @ estimated
    after = pose_errors(moved, true, point_m)
    return AlignedErrorStatistics(
        translation_mm=1e3 * float(np.linalg.norm(shift)),
        rotation_deg=math.degrees(float(np.linalg.norm(log_so3(rotation)))),
        position_rms_mm=after.position_rms_mm,
        orientation_rms_deg=after.orientation_rms_deg,
        hidden_position_mm=before.position_rms_mm - after.position_rms_mm,
        hidden_orientation_deg=before.orientation_rms_deg - after.orientation_rms_deg,
    )
