"""What stamps of a slow instrument add to the errors of poses."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import log_so3

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.simulation.mission import MissionResult

LATE_S = 0.03
"""Of stamps by a client that began while its instrument was slower than usual, times by how much it was: 70 ms are seen where
responses take four times as long. Nothing tells the client (docs/explanation/instrument-time.md).
"""

_HALF_STEP_S = 0.05  # Of the differences that give the robot's speed


def late_stamp_tolerances(result: MissionResult, at_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """By how much poses at true times, (N,), may be late: in m at the prisms' centroid and in rad, (N, 2)."""
    late_s = np.zeros(len(at_s))
    for station_log in result.station_logs.values():
        slow = [each for each in station_log.reported_distances if each.slowed_by > 1.0]
        if slow and len(station_log.journals) > 1:
            factor = max(each.slowed_by for each in slow)
            since_s = min(each.true_ns for each in slow) / 1e9
            late_s = np.maximum(late_s, np.where(at_s >= since_s, LATE_S * (factor - 1.0), 0.0))
    tolerances = np.zeros((len(at_s), 2))
    if late_s.any():
        before, after = result.true_poses(at_s - _HALF_STEP_S), result.true_poses(at_s + _HALF_STEP_S)
        prisms_m = np.array([each.position_m for each in result.parameters.prisms])
        moved = (after - before)[:, :3, :3] @ prisms_m.T + (after - before)[:, :3, 3:]
        tolerances[:, 0] = late_s * np.linalg.norm(moved, axis=1).max(axis=1) / (2 * _HALF_STEP_S)
        turned = np.linalg.norm(log_so3(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)), axis=1)
        tolerances[:, 1] = late_s * turned / (2 * _HALF_STEP_S)
        if len(prisms_m) > 1:  # of which one is measured late
            arm_m = min(float(np.linalg.norm(a - b)) for a, b in combinations(prisms_m, 2))
            tolerances[:, 1] += tolerances[:, 0] / arm_m
    return tolerances
