"""The cause of a wrong set-up of the IMU is named from a recording."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.inertial.imu_calibration import (
    calibrated_imu,
    imu_records,
    parameters_of,
    point_measurements,
    uncalibrated_drive,
)
from harness.inertial.imu_recording import imu_recording, shaken_drive

from tsgt.analysis.imu_setup import RecordedSetup, recorded_imu_setup
from tsgt.analysis.smoothing import smooth_recording
from tsgt.errors import RecordingError

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.slow
def test_wrong_setup_is_named() -> None:
    """The set-up of the calibration is right, a clock that is 10 ms off is not."""
    drive = uncalibrated_drive(60.0, seed=5)
    imu = calibrated_imu(drive)
    measurements, samples = point_measurements(drive), imu_records(drive)
    right = recorded_imu_setup(parameters_of(drive, imu), measurements, samples)
    assert right.confirmed
    assert not right.wrong
    late = parameters_of(drive, replace(imu, latency_ns=imu.latency_ns + 10_000_000))
    wrong = recorded_imu_setup(late, measurements, samples)
    assert "the latency of the IMU is wrong" in wrong.wrong
    assert not wrong.confirmed
    assert not wrong.has_moved


@pytest.mark.slow
def test_two_stations_with_a_wrong_setup_give_no_poses(tmp_path: Path) -> None:
    """Without three there are none without the IMU, and those with it would be wrong."""
    recording = imu_recording(shaken_drive(70.0), stations=2)
    imu = recording.parameters.imu
    assert imu is not None
    assert smooth_recording(recording, path=tmp_path, refine="off").imu is not None
    late = replace(recording.parameters, imu=replace(imu, latency_ns=imu.latency_ns + 10_000_000))
    with pytest.raises(RecordingError, match=r"the latency of the IMU is wrong.*--imu-setup"):
        smooth_recording(replace(recording, parameters=late), path=tmp_path, refine="off")


def test_nothing_is_known_without_samples() -> None:
    """Nor without measurements."""
    drive = uncalibrated_drive(2.0)
    parameters = parameters_of(drive, drive.imu)
    assert recorded_imu_setup(parameters, point_measurements(drive), []) == RecordedSetup()
    assert recorded_imu_setup(parameters, [], imu_records(drive)) == RecordedSetup()
