"""What stamps of a slow instrument add to the errors of poses."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tsgt.simulation.checks.poses.late_stamps import LATE_S, late_stamp_tolerances

SPEED_MPS = 1.5


def _poses(at_s: np.ndarray) -> np.ndarray:
    found = np.tile(np.eye(4), (len(at_s), 1, 1))
    found[:, 0, 3] = SPEED_MPS * at_s
    return found


@pytest.mark.parametrize(("starts", "late"), [(1, False), (2, True)])
def test_only_a_restarted_client_of_a_slow_instrument_is_late(starts: int, *, late: bool) -> None:
    """From when it is slow on, by the way that the robot drives meanwhile."""
    reported = [
        SimpleNamespace(true_ns=t * 1_000_000_000, slowed_by=4.0 if t >= 60 else 1.0) for t in range(90)
    ]
    station = SimpleNamespace(reported_distances=reported, journals=["a"] * starts)
    prism = SimpleNamespace(position_m=(0.1, 0.2, 1.0))
    result: Any = SimpleNamespace(
        station_logs={1: station}, parameters=SimpleNamespace(prisms=[prism]), true_poses=_poses
    )
    found = late_stamp_tolerances(result, np.array([50.0, 70.0]))
    expected_m = 3.0 * LATE_S * SPEED_MPS if late else 0.0
    np.testing.assert_allclose(found, [[0.0, 0.0], [expected_m, 0.0]], atol=1e-9)
