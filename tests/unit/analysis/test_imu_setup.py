"""The cause of a wrong set-up of the IMU is named from a recording."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.imu_calibration import (
    calibrated_imu,
    imu_records,
    parameters_of,
    point_measurements,
    uncalibrated_drive,
)

from tsgt.analysis.imu_setup import wrong_imu_setup


@pytest.mark.slow
def test_wrong_setup_is_named() -> None:
    """The set-up of the calibration is right, a clock that is 10 ms off is not."""
    drive = uncalibrated_drive(60.0, seed=5)
    imu = calibrated_imu(drive)
    measurements, samples = point_measurements(drive), imu_records(drive)
    assert wrong_imu_setup(parameters_of(drive, imu), measurements, samples) == ""
    late = parameters_of(drive, replace(imu, latency_ns=imu.latency_ns + 10_000_000))
    assert "the latency of the IMU is wrong" in wrong_imu_setup(late, measurements, samples)


def test_nothing_is_known_without_samples() -> None:
    """Nor without measurements."""
    drive = uncalibrated_drive(2.0)
    parameters = parameters_of(drive, drive.imu)
    assert wrong_imu_setup(parameters, point_measurements(drive), []) == ""
    assert wrong_imu_setup(parameters, [], imu_records(drive)) == ""
