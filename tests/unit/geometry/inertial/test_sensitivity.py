"""Sensitivity of a trajectory with an IMU to the set-up, and the expected residuals, each against fits to other measurements."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial.inertial_drive import imu_parameters, inertial_drive
from scipy.spatial.transform import Rotation

from tsgt.geometry.inertial import InertialFixedLagSmoother, fit_inertial_trajectory
from tsgt.geometry.motion_calibration import Setup, SetupParameters
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialFit, InertialSamples
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations, States
    from tsgt.model import ImuParameters

SHIFT_M = 0.002
IMU = imu_parameters()
DRIVE = inertial_drive(14.0, seed=12)
CENTROID = DRIVE.layout.mean(axis=0)
SAMPLES = DRIVE.samples(IMU)
OBSERVATIONS = replace(DRIVE.measure(), layout=DRIVE.layout - CENTROID)


def fit(observations: Observations, *columns: int) -> InertialFit:
    """Fit; of the set-up's parameters, those of ``columns`` have a sigma of SHIFT_M."""
    setup = Setup.of(observations)
    parameters = SetupParameters.of(setup, np.zeros(3), range(3))

    def jacobian(some: Observations, linearised: LinearisedMeasurements) -> FloatArray:
        return SHIFT_M * parameters.jacobian(some, linearised, setup)[:, :, list(columns)]

    return fit_inertial_trajectory(
        observations, SAMPLES, IMU, reference_m=CENTROID, setup_jacobian=jacobian if columns else None
    )


@pytest.mark.slow
def test_common_covariance_is_that_of_a_displaced_set_up() -> None:
    """A station and a prism that are elsewhere move the poses as stated."""
    parameters = SetupParameters.of(Setup.of(OBSERVATIONS), np.zeros(3), range(3))
    time_s = np.arange(2.0, 12.0, 0.5)
    frames, layout = OBSERVATIONS.frames.copy(), OBSERVATIONS.layout.copy()
    frames[1, 0, 3] += SHIFT_M
    layout[2, 1] += SHIFT_M
    for column, changed in (
        (parameters.translations[0, 0], replace(OBSERVATIONS, frames=frames)),
        (parameters.prisms[2, 1], replace(OBSERVATIONS, layout=layout)),
    ):
        found = fit(OBSERVATIONS, int(column))
        common = found.trajectory.common_at(time_s)
        assert common is not None
        moved = fit(changed).trajectory.at(time_s)[0].position - found.trajectory.at(time_s)[0].position
        expected = np.sqrt(np.einsum("nii->ni", common)[:, :3])
        assert expected.max() > 0.2 * SHIFT_M
        assert np.abs(np.abs(moved) - expected).max() < 0.03 * SHIFT_M


def test_residuals_have_the_expected_variances() -> None:
    """Normalised by them, residuals have the standard deviation 1, in range and across the line of sight."""
    found = fit(OBSERVATIONS)
    normalised = found.residuals_m / np.sqrt(found.residual_variances_m2)
    assert normalised.std(axis=0).min() > 0.85
    assert normalised.std(axis=0).max() < 1.1


MOUNTING_ERROR = np.array([0.003, -0.004, 0.002, 2e-3, -1.5e-3, 2.5e-3, 4e-4])
"""Of position in m, rotation in rad, latency in s."""


def wrong_mounting() -> tuple[ImuParameters, InertialSamples]:
    """Return an IMU that sits where the error has it, and the samples at its times."""
    turned = Rotation.from_rotvec(MOUNTING_ERROR[3:6]) * Rotation.from_quat(IMU.orientation_xyzw)
    imu = replace(
        IMU,
        position_m=tuple((IMU.position_m + MOUNTING_ERROR[:3]).tolist()),
        orientation_xyzw=tuple(turned.as_quat().tolist()),
    )
    return imu, replace(SAMPLES, end_s=SAMPLES.end_s - MOUNTING_ERROR[6])


def moved_by(found: States, wrong: States) -> FloatArray:
    """(N, 6) errors of position, and of the rotation about the robot's own axes."""
    return wrong.local_coordinates_about(found)[:, :6]


def no_setup(observations: Observations, _: LinearisedMeasurements) -> FloatArray:
    """Return that nothing but the mounting is uncertain."""
    return np.zeros((len(observations), 3, 1))


def check(moved: FloatArray, common: FloatArray) -> None:
    """Compare a displacement with the covariance of one column: both have the same outer product, but for their second order."""
    scale = np.sqrt(np.einsum("ni,ni->i", moved, moved) / len(moved))
    normalised = common / scale / scale[:, None]
    expected = np.einsum("ni,nj->nij", moved / scale, moved / scale)
    assert np.abs(normalised - expected).mean() < 0.15 * np.abs(expected).mean()


@pytest.mark.slow
@pytest.mark.parametrize("stations", [1, 2])
def test_common_covariance_is_that_of_a_displaced_imu(stations: int) -> None:
    """An IMU that sits elsewhere, turned, and whose samples are late moves the poses as stated."""
    observations = replace(DRIVE.measure(stations=stations), layout=DRIVE.layout - CENTROID)
    time_s = np.arange(2.0, 12.0, 0.53)
    found = fit_inertial_trajectory(
        observations,
        SAMPLES,
        IMU,
        reference_m=CENTROID,
        setup_jacobian=no_setup,
        mounting_factor=MOUNTING_ERROR[:, None],
    ).trajectory
    imu, samples = wrong_mounting()
    wrong = fit_inertial_trajectory(observations, samples, imu, reference_m=CENTROID).trajectory
    common = found.common_at(time_s)
    assert common is not None
    check(moved_by(found.at(time_s)[0], wrong.at(time_s)[0]), common)


@pytest.mark.slow
def test_live_common_covariance_is_that_of_a_displaced_imu() -> None:
    """Of predictions and of smoothed poses, from two stations."""
    observations = replace(DRIVE.measure(stations=2), layout=DRIVE.layout - CENTROID)
    windows = [
        InertialFixedLagSmoother(
            each,
            MotionPrior(),
            reference_m=CENTROID,
            setup_jacobian=no_setup,
            mounting_factor=MOUNTING_ERROR[:, None],
        )
        for each in (IMU, wrong_mounting()[0])
    ]
    poses: list[tuple[FloatArray, ...]] = [(), ()]
    commons: list[tuple[FloatArray, ...]] = [(), ()]
    for now_s in np.arange(0.5, 13.5, 0.5).tolist():
        for window, samples in zip(windows, (SAMPLES, wrong_mounting()[1]), strict=True):
            # The newest sample is 20 ms old.
            arrived = (SAMPLES.end_s <= now_s - 0.02) & (SAMPLES.end_s > now_s - 0.52)
            window.add_samples(samples.select(arrived))
            measured = (observations.time_s <= now_s - 0.3) & (observations.time_s > now_s - 0.8)
            if measured.any():
                window.update(observations.select(measured))
            window.marginalise_before(now_s - 3.0)
        if not all(window.converged for window in windows) or now_s < 9.0:
            continue
        then_s = np.array([now_s - 1.17])
        states = [(each.predict(now_s)[0], each.trajectory().at(then_s)[0]) for each in windows]
        at_both = windows[0].common_at(now_s), windows[0].trajectory().common_at(then_s)
        for kind, common in enumerate(at_both):
            assert common is not None
            poses[kind] += (moved_by(states[0][kind], states[1][kind])[0],)
            commons[kind] += (common[0],)
    for moved, covariances in zip(poses, commons, strict=True):
        assert len(moved) >= 8
        check(np.array(moved), np.array(covariances))
