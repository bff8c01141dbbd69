"""First guess of mounting and latency from rates and forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tsgt.errors import GeometryError
from tsgt.geometry import FloatArray, exp_so3, log_so3
from tsgt.geometry.inertial_calibration.alignment import GRID_S, Series, align, nearest_rotation

MOUNTED = exp_so3(np.array([0.4, -1.0, 2.2]))
BIAS = np.array([0.02, -0.01, 0.03])


def series(duration_s: float = 60.0, seed: int = 0) -> Series:
    """Return rates and forces of a robot that drives curves over bumps."""
    rng = np.random.default_rng(seed)
    count = round(duration_s / GRID_S)
    kernel = np.hanning(51) / np.hanning(51).sum()

    def noise(*sizes: float) -> FloatArray:
        white = rng.normal(size=(count + 50, 3)) * np.array(sizes) * 5
        return np.stack([np.convolve(each, kernel, "valid") for each in white.T], axis=1)

    upward = np.array([0.0, 0.0, 9.81])
    force = noise(0.5, 0.5, 0.3) + upward
    return Series(5.0, noise(0.05, 0.05, 0.3), force, np.ones(count, np.bool_))


def mounted(robot: Series, rotation: FloatArray, steps: int) -> Series:
    """Return what an IMU gives whose stamps are late by steps of the grid."""
    return replace(
        robot,
        start_s=robot.start_s + steps * GRID_S,
        rate=robot.rate @ rotation + BIAS,
        force=robot.force @ rotation,
    )


@pytest.mark.parametrize("steps", [0, 7, -250, 400])
def test_mounting_latency_and_bias(steps: int) -> None:
    """Any mounting, latencies of seconds, and a bias are found."""
    robot = series()
    found = align(robot, mounted(robot, MOUNTED, steps))
    assert found.latency_s == pytest.approx(steps * GRID_S, abs=1e-3)
    assert np.linalg.norm(log_so3(MOUNTED.T @ found.rotation)) < 1e-6
    np.testing.assert_allclose(found.gyro_bias, BIAS, atol=1e-6)


def test_forces_tell_what_turning_about_one_axis_does_not() -> None:
    """A robot that only yaws leaves the rotation about its vertical to the specific forces."""
    robot = series()
    flat = replace(robot, rate=robot.rate * [0.0, 0.0, 1.0])
    found = align(flat, mounted(flat, MOUNTED, 0))
    assert np.linalg.norm(log_so3(MOUNTED.T @ found.rotation)) < 1e-6


def test_intervals_without_measurements_do_not_count() -> None:
    """What is not known does not disturb."""
    robot = series()
    gap = (np.arange(len(robot.rate)) > 1000) & (np.arange(len(robot.rate)) < 1500)
    wrong = replace(
        robot,
        rate=np.where(gap[:, None], 3.0, robot.rate),
        known=~gap,
        force=np.where(gap[:, None], 50.0, robot.force),
    )
    found = align(wrong, mounted(robot, MOUNTED, 30))
    assert found.latency_s == pytest.approx(30 * GRID_S, abs=1e-3)
    assert np.linalg.norm(log_so3(MOUNTED.T @ found.rotation)) < 1e-6


def test_robot_that_hardly_turns() -> None:
    """Without turning there is nothing to align."""
    robot = series()
    straight = replace(robot, rate=robot.rate * 0.01)
    with pytest.raises(GeometryError, match="hardly turns"):
        align(straight, mounted(straight, MOUNTED, 0))


def test_nearest_rotation_is_no_reflection() -> None:
    """Products that a reflection would fit best still give a rotation."""
    rotation = nearest_rotation(np.diag([3.0, 2.0, -1.0]))
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
