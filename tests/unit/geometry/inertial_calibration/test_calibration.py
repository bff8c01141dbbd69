"""Calibration of an IMU from a drive, without a first guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.inertial.imu_calibration import UncalibratedDrive, uncalibrated_drive

from tsgt.errors import GeometryError
from tsgt.geometry.inertial_calibration import ImuCalibration, calibrate_imu
from tsgt.geometry.inertial_calibration.calibration import variation
from tsgt.geometry.inertial_calibration.setup import ACCELEROMETER_MATRIX, DELAYS, GYRO_MATRIX

DEG = np.pi / 180


@pytest.fixture(scope="module")
def drive() -> UncalibratedDrive:
    """Drive for a little more than a minute with an IMU whose stamps are 3.2 s late."""
    return uncalibrated_drive(64.0, latency_s=3.2043, seed=1)


@pytest.fixture(scope="module")
def found(drive: UncalibratedDrive) -> ImuCalibration:
    """Calibrate it."""
    return calibrate_imu(drive.observations, drive.samples, drive.imu.noise, drive.gravity)


@pytest.mark.slow
def test_setup_is_found_within_its_sigmas(drive: UncalibratedDrive, found: ImuCalibration) -> None:
    """Every component of the error is within four of its sigmas, and their squares are those of a chi-square."""
    error = found.setup.local_coordinates_about(drive.truth)
    assert (np.abs(error) < 4 * found.sigmas).all()
    known = np.r_[0:7, GYRO_MATRIX]
    assert error[known] @ np.linalg.solve(found.covariance[np.ix_(known, known)], error[known]) < 33


def test_a_minute_suffices(drive: UncalibratedDrive, found: ImuCalibration) -> None:
    """Rotation, position and latency are found, and their sigmas are as small."""
    error = np.abs(found.setup.local_coordinates_about(drive.truth))
    for errors in (error, found.sigmas):
        assert errors[0:3].max() < 0.2 * DEG
        assert errors[3:5].max() < 0.006
        assert errors[5] < 0.02
        assert errors[6] < 1.5e-3


def test_data_tell_a_factory_calibration(found: ImuCalibration) -> None:
    """The class of IMUs follows from the evidence; what the motion cannot tell keeps its prior."""
    assert found.log_bayes_factor < -3
    assert found.matrix_sigma == 1e-3
    assert (found.sigmas[DELAYS] <= found.prior.sigmas[DELAYS] * 1.001).all()
    assert (found.sigmas[ACCELEROMETER_MATRIX] <= found.prior.sigmas[ACCELEROMETER_MATRIX] * 1.001).all()


def test_drive_agrees_with_itself(found: ImuCalibration) -> None:
    """Parts of a drive disagree by no more than noise, and residuals are those of the stations."""
    assert found.birge_ratio < 1.5
    assert 0.7 < found.noise_scale < 1.3
    assert (np.abs(found.halves) < 4 * found.halves_sigmas).all()


def test_variation_of_a_rotation() -> None:
    """What changes uniformly during a drive is uncertain by the spread of its values; noise is no change."""
    covariance = np.diag([1e-8, 1e-8, 1e-6])
    values = np.linspace(-1.0, 1.0, 1001)[:, None] * [0.01, 0.0, 0.0]
    difference = values[:500].mean(axis=0) - values[501:].mean(axis=0)
    np.testing.assert_allclose(variation(difference, covariance), np.cov(values.T), rtol=0.02, atol=1e-12)
    assert not variation(np.array([1e-4, -1e-4, 1.5e-3]), covariance).any()


def test_short_drive_is_an_error(drive: UncalibratedDrive) -> None:
    """Less than a minute is too short."""
    some = drive.samples.select(drive.samples.end_s < 33.0)
    with pytest.raises(GeometryError, match="30 s of samples of the IMU are too short"):
        calibrate_imu(drive.observations, some, drive.imu.noise, drive.gravity)


def test_samples_of_another_drive_are_an_error(drive: UncalibratedDrive) -> None:
    """Rates that are not those of the robot have no latency."""
    backwards = replace(drive.samples, angular_rate_radps=drive.samples.angular_rate_radps[::-1].copy())
    with pytest.raises(GeometryError, match="another recording's IMU"):
        calibrate_imu(drive.observations, backwards, drive.imu.noise, drive.gravity)
