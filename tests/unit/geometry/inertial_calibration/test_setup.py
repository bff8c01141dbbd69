"""Errors of a set-up, and the axes that they are counted in."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial.imu_calibration import in_calibrated_axes

from tsgt.geometry import exp_so3
from tsgt.geometry.inertial import Mounting
from tsgt.geometry.inertial_calibration import ImuSetup
from tsgt.geometry.inertial_calibration.setup import accelerometer_directions, gyro_directions, gyro_rotation

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray


def test_retraction_and_local_coordinates_are_inverse() -> None:
    """An error that is added is found again."""
    rng = np.random.default_rng(0)
    setup = ImuSetup.initial(Mounting(exp_so3(rng.normal(size=3)), rng.normal(size=3)), 0.01, 3)
    error = rng.normal(scale=0.1, size=setup.dim)
    np.testing.assert_allclose(setup.retract(error).local_coordinates_about(setup), error, atol=1e-12)


VERTICALS = [np.array([0.0, 0.0, -1.0]), np.array([0.6, 0.0, 0.8]), np.array([0.48, -0.6, 0.64])]


@pytest.mark.parametrize("vertical", VERTICALS)
def test_axes_keep_the_motion_of_the_robot(vertical: FloatArray) -> None:
    """Mounting times matrix stays the same, the rotation stays one, and the matrices keep their free components alone."""
    rng = np.random.default_rng(1)
    matrices = [np.eye(3) + rng.normal(scale=0.02, size=(3, 3)) for _ in range(2)]
    setup = replace(
        ImuSetup.initial(Mounting(exp_so3(rng.normal(size=3)), np.zeros(3)), 0.0, 3),
        gyro_matrix=matrices[0],
        accelerometer_matrix=matrices[1],
        vertical=vertical,
    )
    found = in_calibrated_axes(setup)
    before, after = setup.mounting.rotation, found.mounting.rotation
    np.testing.assert_allclose(after @ after.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(after) > 0
    for was, becomes, directions in (
        (setup.gyro_matrix, found.gyro_matrix, gyro_directions(vertical)),
        (setup.accelerometer_matrix, found.accelerometer_matrix, accelerometer_directions(vertical)),
    ):
        np.testing.assert_allclose(after @ becomes, before @ was, atol=1e-12)
        free = directions.reshape(-1, 9)
        np.testing.assert_allclose(free @ free.T, np.eye(len(free)), atol=1e-12)
        remaining = (becomes - np.eye(3)).ravel()
        assert np.abs(remaining - free.T @ free @ remaining).max() < 1e-7


@pytest.mark.parametrize("vertical", VERTICALS)
def test_rotation_of_the_gyro(vertical: FloatArray) -> None:
    """Turning the gyro alone, or mounting and both sensors, turns its axes alike."""
    setup = ImuSetup.initial(Mounting(np.eye(3), np.zeros(3)), 0.0, 3)
    setup = replace(setup, vertical=vertical)
    turn = 0.01 * vertical
    alone = replace(setup, gyro_matrix=exp_so3(turn))
    mounted = replace(setup, mounting=Mounting(exp_so3(turn), np.zeros(3)))
    for turned in (alone, mounted):
        error = turned.local_coordinates_about(setup)
        np.testing.assert_allclose(gyro_rotation(setup) @ error, turn, atol=1e-6)
