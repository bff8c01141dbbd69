"""What is kept of the published records."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from harness.files.records import POSE, START

from tsgt.simulation.mission.master_log import MasterLog

if TYPE_CHECKING:
    from pathlib import Path


def test_predicted_poses_that_rest_on_the_imu_are_known(tmp_path: Path) -> None:
    """Valid or not, and which of the valid ones."""
    log = MasterLog(tmp_path, lambda: 0, START)
    predicted = replace(POSE, kind="predicted")
    for pose in (
        replace(predicted, imu="unconfirmed"),
        replace(predicted, imu="used"),
        replace(predicted, imu="used", valid=False, reason="uncertain"),
        replace(POSE, kind="smoothed", imu="used", quality="degraded", degraded_by=("imu_unconfirmed",)),
    ):
        log.observe(pose, b"")
    assert log.predicted_with_imu == 2
    assert log.valid_poses().with_imu.tolist() == [False, True, True]
    assert log.valid_poses().unconfirmed.tolist() == [False, False, True]
