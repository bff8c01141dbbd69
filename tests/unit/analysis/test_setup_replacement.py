"""Set-up files in place of the set-up in a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from harness.files.records import IMU_PARAMETERS, PARAMETERS

from tsgt.analysis.setup_replacement import with_imu_mounting
from tsgt.config import ImuMounting


@pytest.mark.parametrize(("higher_m", "shocks"), [(0.0, 2), (0.01, 0)])
def test_shocks_before_a_recording_are_of_its_mounting(higher_m: float, shocks: int) -> None:
    """An IMU that was calibrated anew is where the calibration says; the same calibration says nothing new."""
    parameters = replace(PARAMETERS, imu=replace(IMU_PARAMETERS, shocks_before=2))
    x, y, z = IMU_PARAMETERS.position_m
    mounting = ImuMounting(
        position_m=(x, y, z + higher_m),
        orientation_xyzw=IMU_PARAMETERS.orientation_xyzw,
        latency_ns=3_000_000,
        gyro_matrix=IMU_PARAMETERS.gyro_matrix,
    )
    imu = with_imu_mounting(parameters, mounting, path=Path("imu.toml")).imu
    assert imu is not None
    assert (imu.shocks_before, imu.latency_ns) == (shocks, 3_000_000)
