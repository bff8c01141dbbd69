"""Errors of a set-up, and the axes that they are counted in."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.geometry import exp_so3
from tsgt.geometry.inertial import Mounting
from tsgt.geometry.inertial_calibration import ImuSetup, in_main_axes
from tsgt.geometry.inertial_calibration.setup import gyro_directions


def test_retraction_and_local_coordinates_are_inverse() -> None:
    """An error that is added is found again."""
    rng = np.random.default_rng(0)
    setup = ImuSetup.initial(Mounting(exp_so3(rng.normal(size=3)), rng.normal(size=3)), 0.01, 3)
    error = rng.normal(scale=0.1, size=setup.dim)
    np.testing.assert_allclose(setup.retract(error).local_coordinates_about(setup), error, atol=1e-12)


@pytest.mark.parametrize("main_axis", [0, 1, 2])
def test_main_axes_keep_the_rates_of_the_robot(main_axis: int) -> None:
    """Mounting times matrix stays the same, the rotation stays one, and the matrix keeps its free components alone."""
    rng = np.random.default_rng(1)
    rotation, matrix = exp_so3(rng.normal(size=3)), np.eye(3) + rng.normal(scale=0.02, size=(3, 3))
    turned, found = in_main_axes(rotation, matrix, main_axis)
    np.testing.assert_allclose(turned @ found, rotation @ matrix, atol=1e-12)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turned) > 0
    directions = gyro_directions(main_axis)
    free = directions.reshape(6, 9)
    remaining = (found - np.eye(3)).ravel()
    remaining = remaining - free.T @ np.linalg.solve(free @ free.T, free @ remaining)
    assert np.abs(remaining).max() < 1e-7
