"""Sensitivity of a trajectory with an IMU to the set-up, and the expected residuals, each against fits to other measurements."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial_drive import imu_parameters, inertial_drive

from tsgt.geometry.inertial import fit_inertial_trajectory
from tsgt.geometry.motion_calibration import Setup, SetupParameters

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialFit
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations

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
