"""What status records say of the IMU, against the truth."""

from __future__ import annotations

from array import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tsgt.simulation.checks.devices import imu_status_failures
from tsgt.simulation.mission.master_log import PublishedCounts

STATUSES = 12


@pytest.mark.parametrize(
    ("true_radps", "stated_radps", "use", "valid_poses", "failures"),
    [
        (0.0, 0.02, "used", 5, 1),
        (0.0, 0.02, "used", 0, 0),
        (0.0, 0.02, "unconfirmed", 5, 0),
        (0.0, 0.005, "used", 5, 0),
        (0.03, 0.015, "used", 5, 0),
        (0.03, 0.0, "used", 5, 1),
        (0.009, -0.009, "used", 5, 1),
    ],
)
def test_stated_gyro_bias(
    true_radps: float, stated_radps: float, use: str, valid_poses: int, failures: int
) -> None:
    """It is wrong if it is far from the true one while valid poses rest on the IMU; before, it need not be known."""
    status = SimpleNamespace(
        stamp_ns=0, imu=SimpleNamespace(use=use, gyro_bias_radps=(stated_radps, 0.0, 0.0))
    )
    counts = [PublishedCounts(0, 10 * n, valid_poses * n) for n in range(1, STATUSES + 1)]
    log = SimpleNamespace(
        statuses=[status] * STATUSES,
        imu_uses_at_status=[use] * STATUSES,
        counts_at_status=[(each, each) for each in counts],
        jumps_m=array("d"),
        events=[],
        unix_at_zero_ns=0,
    )
    truth = SimpleNamespace(gyro_bias_radps=np.array([[true_radps, 0.0, 0.0]]))
    imu = SimpleNamespace(truth=truth, samples=SimpleNamespace(arrival_s=np.arange(0.0, 20.0, 0.025)))
    result: Any = SimpleNamespace(master_logs=[log], imu=imu)
    assert len(list(imu_status_failures(result))) == failures
