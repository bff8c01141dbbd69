"""Expected accuracy with an IMU: against a dense least-squares problem, and an integrated motion."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.design import DrivenPath, Station, inertial_accuracy, inertial_study
from tsgt.config import IMU_NOISE
from tsgt.errors import GeometryError
from tsgt.geometry import cartesian_to_polar, measurement_covariance, skew
from tsgt.geometry.inertial import estimation_noise
from tsgt.model import TRACKING_NOISE, ImuParameters

LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])
STATIONS = tuple(
    Station(np.array(place), TRACKING_NOISE, prism)
    for prism, place in enumerate(([0.0, 0.0, 0.0], [2.0, -1.5, 0.1], [-1.5, 2.5, -0.2]))
)
IMU = ImuParameters(
    position_m=(0.2, -0.1, 0.4), orientation_xyzw=(0.0, 0.0, 0.0, 1.0), noise=IMU_NOISE["industrial"]
)
PLACES = np.array([[60.0, 45.0, -1.0], [88.0, 45.0, -1.0], [60.0, 73.0, -1.0], [32.0, 45.0, -1.0]])


def short(path: DrivenPath, steps: int) -> DrivenPath:
    """Return the start of a path."""
    return DrivenPath(
        path.position_m[:steps],
        path.acceleration_mps2[:steps],
        path.rotation[:steps],
        path.yaw_rate_radps[:steps],
    )


def test_transition_is_that_of_the_integrated_motion() -> None:
    """Perturbed states, integrated over a step, against the states without perturbation; gravity tilts."""
    path = DrivenPath.through(PLACES, closed=True)
    row, dt, g = 300, inertial_study.STEP_S, 9.81
    rotation = path.rotation[row]
    rate = np.array([0.0, 0.0, path.yaw_rate_radps[row]])
    force = rotation.T @ (path.acceleration_mps2[row] + [0.0, 0.0, g])

    def moved(error: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turned = rotation @ Rotation.from_rotvec(error[6:9]).as_matrix()
        down = Rotation.from_rotvec([*error[15:17], 0.0]).as_matrix() @ [0.0, 0.0, -g]
        acceleration = turned @ (force - error[12:15] - error[17:].reshape(3, 2) @ force[:2]) + down
        velocity = error[3:6] + dt * acceleration
        position = error[:3] + dt * error[3:6] + dt**2 / 2 * acceleration
        return position, velocity, turned @ Rotation.from_rotvec(dt * (rate - error[9:12])).as_matrix()

    phi = inertial_study._transition(path, row, g)
    position, velocity, after = moved(np.zeros(23))
    for column in range(23):
        error = np.zeros(23)
        error[column] = 1e-6
        p, v, r = moved(error)
        angle = Rotation.from_matrix(after.T @ r).as_rotvec()
        found = np.concatenate([p - position, v - velocity, angle]) / 1e-6
        # The turn within the step, 16 mrad here, is neglected in the effect of the gyro's bias.
        np.testing.assert_allclose(phi[:9, column], found, atol=1e-3)


def test_covariances_are_those_of_a_dense_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    """All instants of a short drive as unknowns of one least-squares problem."""
    monkeypatch.setattr(inertial_study, "START_S", 1.0)
    monkeypatch.setattr(inertial_study, "END_S", 1.0)
    monkeypatch.setattr(inertial_study, "EVALUATED_EVERY", 1000)  # the first one alone
    path = short(DrivenPath.through(PLACES, closed=True), 30)
    point = np.array([0.3, 0.2, 1.0])
    found = inertial_accuracy(LAYOUT, STATIONS, path, IMU, point).smoothed
    n, dim, origin = 30, 23, np.array(IMU.position_m)
    noise = estimation_noise(IMU.noise)
    q = inertial_study._process_noise(noise)
    q[15:, 15:] = 1e-14 * np.eye(8)
    sigmas = np.repeat(
        [1.0, 1.0, 0.5, noise.gyro_bias_radps, noise.accelerometer_bias_mps2, IMU.tilt_sigma_rad, 0.0, 0.0], 3
    )[:dim]
    sigmas[17:] = IMU.noise.accelerometer_scale_misalignment
    information = np.zeros((n * dim, n * dim))
    information[:dim, :dim] = np.diag(1 / sigmas**2)
    for row in range(n - 1):
        phi = inertial_study._transition(path, row, IMU.gravity_mps2)
        jacobian = np.hstack([-phi, np.eye(dim)])
        block = slice(row * dim, (row + 2) * dim)
        information[block, block] += jacobian.T @ np.linalg.inv(q) @ jacobian
    for row in range(n):
        for number, station in enumerate(STATIONS):
            if row % 4 != number * 4 // 3:
                continue
            lever = LAYOUT[number] - origin
            jacobian = np.zeros((3, dim))
            jacobian[:, :3], jacobian[:, 6:9] = np.eye(3), -path.rotation[row] @ skew(lever)
            sight = path.position_m[row] + path.rotation[row] @ lever - station.position_m
            weight = np.linalg.inv(measurement_covariance(*cartesian_to_polar(sight), station.noise))
            block = slice(row * dim, (row + 1) * dim)
            information[block, block] += jacobian.T @ weight @ jacobian
    at = slice(10 * dim, 11 * dim)
    covariance = np.linalg.inv(information)[at, at]
    point_jacobian = np.zeros((3, dim))
    point_jacobian[:, :3], point_jacobian[:, 6:9] = path.rotation[10].T, -skew(point - origin)
    position = point_jacobian @ covariance @ point_jacobian.T
    assert found.position_m == pytest.approx(math.sqrt(np.trace(position)), rel=1e-3)
    assert found.rotation_rad == pytest.approx(math.sqrt(np.trace(covariance[6:9, 6:9])), rel=1e-3)


def test_each_station_adds_and_a_better_imu_too() -> None:
    """And a live pose is less certain than a smoothed one."""
    path = short(DrivenPath.through(PLACES, closed=True), 600)
    point = LAYOUT.mean(axis=0)
    found = [inertial_accuracy(LAYOUT, STATIONS[:n], path, IMU, point) for n in (1, 2, 3)]
    for few, more in pairwise(found):
        assert more.smoothed.position_m < few.smoothed.position_m
        assert more.smoothed.rotation_rad < few.smoothed.rotation_rad
    for each in found:
        assert each.predicted.position_m > 1.5 * each.smoothed.position_m
    consumer = inertial_accuracy(LAYOUT, STATIONS, path, replace(IMU, noise=IMU_NOISE["consumer"]), point)
    assert consumer.smoothed.rotation_rad > 1.3 * found[2].smoothed.rotation_rad


def test_drive_needs_room() -> None:
    """A point is no drive."""
    with pytest.raises(GeometryError, match="expected at least 10 m"):
        DrivenPath.through(np.zeros((5, 3)), closed=True)
    with pytest.raises(GeometryError, match="expected at least 50 m"):
        DrivenPath.through(np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]]), closed=False)
