"""Errors of a set-up, and the gauge that makes the gyro matrix symmetric."""

from __future__ import annotations

import numpy as np

from tsgt.geometry import exp_so3
from tsgt.geometry.inertial import Mounting
from tsgt.geometry.inertial_calibration import ImuSetup, symmetric_gauge


def test_retraction_and_local_coordinates_are_inverse() -> None:
    """An error that is added is found again."""
    rng = np.random.default_rng(0)
    setup = ImuSetup.initial(Mounting(exp_so3(rng.normal(size=3)), rng.normal(size=3)), 0.01, 3)
    error = rng.normal(scale=0.1, size=setup.dim)
    np.testing.assert_allclose(setup.retract(error).local_coordinates_about(setup), error, atol=1e-12)


def test_symmetric_gauge_keeps_the_rates_of_the_robot() -> None:
    """Mounting times matrix stays the same, the matrix becomes symmetric and the rotation stays one."""
    rng = np.random.default_rng(1)
    rotation, matrix = exp_so3(rng.normal(size=3)), np.eye(3) + rng.normal(scale=0.01, size=(3, 3))
    turned, symmetric = symmetric_gauge(rotation, matrix)
    np.testing.assert_allclose(turned @ symmetric, rotation @ matrix, atol=1e-12)
    np.testing.assert_allclose(symmetric, symmetric.T, atol=1e-12)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turned) > 0
