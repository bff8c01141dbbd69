"""Uncertainty of the set-up with an IMU: one factor for stations, prisms and mounting, and what a refinement keeps of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from harness.files.records import IMU_PARAMETERS, PARAMETERS

from tsgt.estimation import InertialSetupUncertainty, uncertain_setup, with_setup
from tsgt.model import SetupCovariance

COMPONENTS = ("station2.x", "imu.latency", "imu.rotation_z", "imu.gyro_11", "prism1.y")


def covariance() -> SetupCovariance:
    """Return a covariance in which all components are correlated."""
    root = np.random.default_rng(1).normal(size=(5, 5)) * np.array([2e-3, 5e-4, 1e-3, 1e-4, 1e-3])[:, None]
    matrix = root @ root.T
    return SetupCovariance(
        components=COMPONENTS, matrix=tuple(map(tuple, (0.5 * (matrix + matrix.T)).tolist()))
    )


def test_factor_has_the_covariance_of_the_mounting() -> None:
    """Position, rotation and latency in this order; what is not stated is exact."""
    known = covariance()
    parameters = replace(PARAMETERS, imu=IMU_PARAMETERS, setup_covariance=known)
    factor = InertialSetupUncertainty.of(parameters).mounting_factor
    assert factor is not None
    found = factor @ factor.T
    matrix = np.array(known.matrix)
    expected = np.zeros((7, 7))
    expected[np.ix_([6, 5], [6, 5])] = matrix[1:3, 1:3]
    np.testing.assert_allclose(found, expected, atol=1e-12 * matrix.max())
    assert InertialSetupUncertainty.of(replace(parameters, setup_covariance=None)) == (None, None)


def test_refinement_keeps_what_is_known_of_the_imu() -> None:
    """It estimates stations and prisms alone."""
    parameters = replace(PARAMETERS, imu=IMU_PARAMETERS, setup_covariance=covariance())
    layout = uncertain_setup(parameters)
    refined = np.zeros((layout.count, layout.count))
    refined[layout.prisms[0, 1], layout.prisms[0, 1]] = 1e-8
    found = with_setup(parameters, layout, layout.reference, refined).setup_covariance
    assert found is not None
    assert found.components == ("prism1.y", "imu.latency", "imu.rotation_z", "imu.gyro_11")
    np.testing.assert_allclose(
        np.array(found.matrix)[1:, 1:], np.array(covariance().matrix)[1:4, 1:4], rtol=1e-12
    )
    assert not np.array(found.matrix)[0, 1:].any()
