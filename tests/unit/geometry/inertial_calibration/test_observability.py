"""What a drive leaves undetermined is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.inertial.imu_calibration import uncalibrated_drive

from tsgt.geometry.inertial_calibration import (
    ImuCalibration,
    SetupComponent,
    calibrate_imu,
    robot_covariance,
    setup_components,
)
from tsgt.geometry.inertial_calibration.calibration import FACTORY_CALIBRATED

pytestmark = pytest.mark.slow  # A calibration of two seconds


@pytest.fixture(scope="module")
def found() -> ImuCalibration:
    """Calibrate a chip from a drive on flat ground."""
    drive = uncalibrated_drive(64.0, grade="consumer", seed=3, flat=True)
    found = calibrate_imu(drive.observations, drive.samples, drive.imu.noise, drive.gravity)
    error = found.setup.local_coordinates_about(drive.truth)
    assert (np.abs(error) < 4 * found.sigmas).all()
    return found


def undetermined(components: list[SetupComponent]) -> list[str]:
    """Return names."""
    return [each.name for each in components if not each.determined]


def test_flat_ground_leaves_height_and_other_axes_undetermined(found: ImuCalibration) -> None:
    """A robot that only yaws tells the scale of one axis of the gyro, and not the height of the IMU."""
    names = undetermined(setup_components(found))
    assert set(names) >= {
        "position along the robot's z",
        "scale of the gyro's x",
        "scale of the gyro's y",
        "cross-axis sensitivity of the gyro's x to y",
        "cross-axis sensitivity of the gyro's y to x",
    }
    assert not {name for name in names if "rotation" in name or name == "scale of the gyro's z"}
    height = next(each for each in setup_components(found) if each.name == "position along the robot's z")
    assert height.sigma > 0.1
    assert "slopes" in height.advice


def test_factory_calibration_needs_no_motion(found: ImuCalibration) -> None:
    """Where the prior of the gyro matrix suffices, nothing of it is named."""
    factory = replace(found, matrix_sigma=FACTORY_CALIBRATED)
    assert not [name for name in undetermined(setup_components(factory)) if "gyro" in name]


def test_covariance_in_the_robot_frame(found: ImuCalibration) -> None:
    """Rotation is about the axes of the robot, and the gyro matrix has all its entries."""
    covariance = robot_covariance(found)
    components = setup_components(found)
    sigmas = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(sigmas[3:6], [each.sigma for each in components[:3]])
    np.testing.assert_allclose(sigmas[0:3], [each.sigma for each in components[3:6]])
    np.testing.assert_allclose(sigmas[7:].reshape(3, 3).diagonal(), [each.sigma for each in components[7:10]])
    assert np.linalg.eigvalsh(covariance).min() > -1e-12
