"""How far poses are from the truth: unaligned, root mean squares over the inner part of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import invert, log_so3, transform_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

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


def inner_part(stamp_ns: NDArray[np.int64], start_ns: int, end_ns: int) -> NDArray[np.bool_]:
    """Tell, (N,), which instants count in a run's figures: those :data:`EDGE_NS` away from its start and end."""
    inner: NDArray[np.bool_] = (stamp_ns >= start_ns + EDGE_NS) & (stamp_ns <= end_ns - EDGE_NS)
    return inner


def _rms(values: NDArray[np.float64]) -> float:
    return math.sqrt(float(np.mean(values**2))) if len(values) else math.nan
