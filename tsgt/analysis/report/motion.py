"""Inter-prism errors by the motion of the robot. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import centroid_point, poses_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.evaluation import EpochDistances
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray
    from tsgt.model import Parameters


@dataclass(frozen=True, slots=True)
class RobotMotion:
    """Motion of a robot at N epochs, (N,) each; NaN without a valid pose.

    Speed of the prisms' centroid, its derivative (negative while braking), and norm of the angular velocity.
    """

    speed_mps: FloatArray
    acceleration_mps2: FloatArray
    angular_rate_radps: FloatArray

    @classmethod
    def unknown(cls, n: int) -> RobotMotion:
        """Return N unknown values."""
        return cls(*(np.full(n, np.nan) for _ in range(3)))


@dataclass(frozen=True, slots=True)
class DistanceErrorSeries:
    """Inter-prism errors (measured minus layout, (N,) by pair; NaN in a gap) and motion at 20 Hz where all tracks have data."""

    stamp_ns: NDArray[np.int64]
    error_m: dict[str, FloatArray]
    motion: RobotMotion


def distance_error_series(
    parameters: Parameters, found: EpochDistances, poses: PoseBatch | None
) -> DistanceErrorSeries:
    """Relate inter-prism errors to the motion of the robot, which follows from ``poses`` (None: unknown)."""
    error_m = {f"{a}-{b}": m - found.references_m[a, b] for (a, b), m in found.distances_m.items()}
    unknown = RobotMotion.unknown(len(found.stamp_ns))
    if poses is None:
        return DistanceErrorSeries(found.stamp_ns, error_m, unknown)
    motion = _motion(poses_at(poses, centroid_point(parameters)), found.stamp_ns)
    return DistanceErrorSeries(found.stamp_ns, error_m, motion)


def _motion(poses: PoseBatch, epochs: NDArray[np.int64]) -> RobotMotion:
    if len(poses) < 2:
        return RobotMotion.unknown(len(epochs))
    rows = poses.valid
    time_s = (poses.stamp_ns - poses.stamp_ns[0]) / 1e9
    speed = np.where(rows, np.linalg.norm(poses.velocity_mps, axis=1), np.nan)
    angular_rate = np.where(rows, np.linalg.norm(poses.angular_velocity_radps, axis=1), np.nan)
    at_s = (epochs - poses.stamp_ns[0]) / 1e9
    columns = (speed, np.gradient(speed, time_s), angular_rate)
    return RobotMotion(*(np.interp(at_s, time_s, column, left=np.nan, right=np.nan) for column in columns))
