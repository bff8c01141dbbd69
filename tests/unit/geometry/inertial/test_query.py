"""Poses between knots: against a solution that has knots there, and the geometry of the reference point."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from harness.inertial.inertial_drive import imu_parameters, inertial_drive

from tsgt.errors import GeometryError
from tsgt.geometry import FloatArray, exp_so3, log_so3
from tsgt.geometry.inertial import (
    Gravity,
    InertialSetup,
    InertialSolution,
    InertialTrajectory,
    Mounting,
    contiguous,
    search_heading,
    solve_inertial,
    states_on_tracks,
)
from tsgt.model import MotionPrior

IMU = imu_parameters()
DRIVE = inertial_drive(8.0, seed=12)
REFERENCE = DRIVE.layout.mean(axis=0)
MOUNTING = Mounting.of(IMU, REFERENCE)
QUERIES_S = np.array([3.021, 3.1, 3.477, 4.2505])


@cache
def solved(*, gyro_only: bool, extra: bool) -> tuple[InertialTrajectory, InertialSolution]:
    """Solve with the knots of the measurements, or with further ones at the queries."""
    prior = MotionPrior() if gyro_only else None
    mounting = replace(MOUNTING, position=np.zeros(3)) if gyro_only else MOUNTING
    observations = DRIVE.measure(seed=1)
    observations = replace(observations, layout=mounting.in_imu(observations.layout - REFERENCE))
    samples = contiguous(DRIVE.samples(IMU), IMU.noise)
    setup = InertialSetup(samples, IMU.noise, prior)
    start = search_heading(observations, setup, Gravity.of(IMU)).solution
    time_s = np.sort(np.concatenate([start.knots.time_s, QUERIES_S])) if extra else start.knots.time_s
    nearest = np.abs(time_s[:, None] - start.knots.time_s).argmin(axis=1)
    guess = states_on_tracks(observations, time_s, start.knots.rotation[nearest], np.zeros(3))
    solution = solve_inertial(observations, setup, guess, Gravity.of(IMU))
    trajectory = InertialTrajectory(
        solution.knots, solution.gravity, samples, mounting, *solution.factor.marginals(), prior
    )
    return trajectory, solution


@pytest.mark.parametrize("gyro_only", [False, True], ids=["accelerometer", "gyro_only"])
def test_pose_between_knots_is_that_of_a_knot_there(gyro_only: bool) -> None:  # noqa: FBT001
    """Mean and covariance equal those of a solution with knots at the queries, which nothing measures."""
    states, covariance = solved(gyro_only=gyro_only, extra=False)[0].at(QUERIES_S)
    expected, expected_covariance = solved(gyro_only=gyro_only, extra=True)[0].at(QUERIES_S)
    np.testing.assert_allclose(states.position, expected.position, atol=1e-5)
    np.testing.assert_allclose(states.velocity, expected.velocity, atol=2e-4)
    error = log_so3(np.swapaxes(expected.rotation, 1, 2) @ states.rotation)
    np.testing.assert_allclose(error, 0.0, atol=1e-5)
    scale = np.sqrt(np.einsum("nii->ni", expected_covariance))
    scale = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(covariance / scale, expected_covariance / scale, atol=0.01)


@pytest.mark.parametrize("gyro_only", [False, True], ids=["accelerometer", "gyro_only"])
def test_pose_at_knots(gyro_only: bool) -> None:  # noqa: FBT001
    """At knots the pose is the knot's, moved to the reference point."""
    trajectory, solution = solved(gyro_only=gyro_only, extra=False)
    knots = solution.knots.select(slice(5, 20))
    states, covariance = trajectory.at(knots.time_s)
    rotation = knots.rotation @ trajectory.mounting.rotation.T
    position = knots.position - rotation @ trajectory.mounting.position
    np.testing.assert_allclose(states.position, position, atol=1e-9)
    np.testing.assert_allclose(states.rotation, rotation, atol=1e-9)
    # Errors of the IMU's pose, drawn, against the covariance of the reference point's.
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(trajectory.covariance[5, :6, :6])
    drawn = rng.normal(size=(20_000, 6)) @ root.T
    turned = knots.rotation[0] @ exp_so3(drawn[:, 3:]) @ trajectory.mounting.rotation.T
    errors = np.concatenate(
        [
            knots.position[0] + drawn[:, :3] - turned @ trajectory.mounting.position - position[0],
            log_so3(rotation[0].T @ turned),
        ],
        axis=1,
    )
    scale = np.sqrt(np.diag(covariance[0]))
    found = errors.T @ errors / len(errors)
    np.testing.assert_allclose(
        covariance[0] / np.outer(scale, scale), found / np.outer(scale, scale), atol=0.05
    )


def test_rates_are_derivatives_of_poses() -> None:
    """Velocity and angular velocity are those of the poses, within the shaking of the samples."""
    trajectory = solved(gyro_only=False, extra=False)[0]
    h = 0.01
    states = trajectory.at(QUERIES_S)[0]
    before, after = (trajectory.at(QUERIES_S + step)[0] for step in (-h, h))
    np.testing.assert_allclose(states.velocity, (after.position - before.position) / (2 * h), atol=0.005)
    rate = log_so3(np.swapaxes(before.rotation, 1, 2) @ after.rotation) / (2 * h)
    np.testing.assert_allclose(states.angular_velocity, rate, atol=0.01)


def test_time_outside_the_knots() -> None:
    """There is no pose outside the knots."""
    with pytest.raises(GeometryError, match=r"asked for 2.000 to 99.000 s"):
        solved(gyro_only=False, extra=False)[0].at(np.array([2.0, 99.0]))


def test_displacement_by_the_setup() -> None:
    """What displaces all states alike displaces the poses between them."""
    trajectory = solved(gyro_only=False, extra=False)[0]
    count = len(trajectory.knots)
    displacement = np.zeros((count, 15, 1))
    displacement[:, :3, 0] = [0.003, 0.0, 0.001]
    displaced = replace(trajectory, displacement=displacement)
    common = displaced.common_at(QUERIES_S)
    expected: FloatArray = np.zeros((6, 6))
    expected[:3, :3] = np.outer([0.003, 0.0, 0.001], [0.003, 0.0, 0.001])
    assert common is not None
    np.testing.assert_allclose(common, np.broadcast_to(expected, common.shape), atol=1e-9)
    assert trajectory.common_at(QUERIES_S) is None
    states, covariance, together = displaced.poses_at(QUERIES_S)
    np.testing.assert_array_equal(together, common)
    np.testing.assert_array_equal(covariance, trajectory.at(QUERIES_S)[1])
    np.testing.assert_array_equal(states.position, trajectory.at(QUERIES_S)[0].position)
    assert trajectory.poses_at(QUERIES_S)[2] is None
