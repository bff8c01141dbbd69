"""Expected accuracy of a pose with an IMU, from one station or more: covariance analysis along a drive. Sans-I/O.

The error of position, velocity, rotation, biases, tilt of gravity and the accelerometer's axes is propagated along a path by the noise of the IMU, and
corrected by measurements of the stations in turn: Kalman filter and Rauch-Tung-Striebel smoother on covariances alone (P.
S. Maybeck, *Stochastic Models, Estimation, and Control*, 1979, chapter 6), as the model is linear in small errors. Not included: errors
of the set-up (frames, prisms, mounting of the IMU).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from tsgt.analysis.design.layout_study import PoseAccuracy
from tsgt.errors import GeometryError
from tsgt.geometry import cartesian_to_polar, exp_so3, measurement_covariance, skew
from tsgt.geometry.inertial import estimation_noise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.design.layout_study import Station
    from tsgt.geometry import FloatArray
    from tsgt.model import ImuNoise, ImuParameters

STEP_S = 0.1
MEASUREMENTS_HZ = 2.5  # of each station
MEASUREMENT_AGE_S = 0.3  # of the newest measurement when a live pose is sent, through the radio

MEAN_SPEED_MPS, SPEED_CHANGE_MPS, SPEED_PERIOD_S = 1.0, 0.5, 8.0
MAX_DURATION_S = 300.0
MIN_LOOP_M = 10.0
START_S, END_S = 20.0, 5.0  # at the ends of the drive, not evaluated
EVALUATED_EVERY = 5  # steps

_P, _V, _R, _BG, _BA, _TILT, _MATRIX = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    slice(9, 12),
    slice(12, 15),
    slice(15, 17),
    slice(17, 23),  # what forces along x and y of the robot add along each of its axes
)
_DIM = 23
_START_SIGMAS = np.repeat([1.0, 1.0, 0.5], 3)  # of position in m, velocity in m/s, rotation in rad


@dataclass(frozen=True, slots=True)
class DrivenPath:
    """A level robot on a path at N instants, STEP_S apart; world axes.

    Attributes
    ----------
    position_m, acceleration_mps2 : (N, 3) of the robot's origin.
    rotation : (N, 3, 3) ``R_world_robot``, x along the path.
    yaw_rate_radps : (N,).
    """

    position_m: FloatArray
    acceleration_mps2: FloatArray
    rotation: FloatArray
    yaw_rate_radps: FloatArray

    @classmethod
    def through(cls, places_m: FloatArray, *, closed: bool) -> DrivenPath:
        """Drive a smooth curve through places, (M, 3), at 0.5 to 1.5 m/s; ``closed``: round and round.

        Raises GeometryError if the path is too short for a drive.
        """
        places = np.vstack([places_m, places_m[:1]]) if closed else places_m
        arc_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
        shortest_m = MIN_LOOP_M if closed else 2 * (START_S + END_S) * MEAN_SPEED_MPS
        if arc_m[-1] < shortest_m:
            raise GeometryError(
                f"a drive of {arc_m[-1]:g} m is too short: expected at least {shortest_m:g} m"
            )
        distinct = np.concatenate([[True], np.diff(arc_m) > 0])
        curve = CubicSpline(arc_m[distinct], places[distinct], bc_type="periodic" if closed else "natural")
        duration_s = MAX_DURATION_S if closed else min(MAX_DURATION_S, arc_m[-1] / MEAN_SPEED_MPS)
        time_s = np.arange(0.0, duration_s, STEP_S)
        phase = 2 * np.pi / SPEED_PERIOD_S
        driven_m = MEAN_SPEED_MPS * time_s + SPEED_CHANGE_MPS / phase * np.sin(phase * time_s)
        position = curve(np.mod(driven_m, arc_m[-1]) if closed else np.minimum(driven_m, arc_m[-1]))
        velocity = np.gradient(position, STEP_S, axis=0)
        yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        return cls(
            position,
            np.gradient(velocity, STEP_S, axis=0),
            exp_so3(np.column_stack([np.zeros((len(yaw), 2)), yaw])),
            np.gradient(yaw, STEP_S),
        )


@dataclass(frozen=True, slots=True)
class InertialAccuracy:
    """Expected accuracy of smoothed poses, and of predicted ones when they are sent."""

    smoothed: PoseAccuracy
    predicted: PoseAccuracy


def inertial_accuracy(
    layout: FloatArray, stations: Sequence[Station], path: DrivenPath, imu: ImuParameters, point_m: FloatArray
) -> InertialAccuracy:
    """Return the expected accuracy of a point, (3,) in the robot frame in m, with an IMU, on a path.

    ``layout``: (P, 3) prisms in the robot frame in m.
    """
    origin = np.array(imu.position_m)
    noise = _process_noise(estimation_noise(imu.noise))
    steps = [_transition(path, row, imu.gravity_mps2) for row in range(len(path.position_m) - 1)]
    filtered, propagated = _filter(layout - origin, stations, path, imu, steps, noise)
    smoothed = _smooth(filtered, propagated, steps)
    rows = range(round(START_S / STEP_S), len(filtered) - round(END_S / STEP_S), EVALUATED_EVERY)
    age = round(MEASUREMENT_AGE_S / STEP_S)
    lever = skew(np.asarray(point_m, dtype=np.float64) - origin)
    predicted = [_propagated(filtered[row - age], steps[row - age : row], noise) for row in rows]
    return InertialAccuracy(
        *(
            PoseAccuracy.of(
                np.array(
                    [
                        _of_point(each, path.rotation[row], lever)
                        for each, row in zip(found, rows, strict=True)
                    ]
                )
            )
            for found in ([smoothed[row] for row in rows], predicted)
        )
    )


def _transition(path: DrivenPath, row: int, gravity_mps2: float) -> FloatArray:
    """Return the transition (23, 23) of the error over a step."""
    dt, rotation = STEP_S, path.rotation[row]
    force = rotation.T @ (path.acceleration_mps2[row] + [0.0, 0.0, gravity_mps2])
    turned = -rotation @ skew(force)
    tilted = -gravity_mps2 * np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])
    scaled = -np.kron(rotation, force[:2])
    phi = np.eye(_DIM)
    phi[_P, _V] = dt * np.eye(3)
    for columns, effect in ((_R, turned), (_BA, -rotation), (_TILT, tilted), (_MATRIX, scaled)):
        phi[_V, columns] = dt * effect
        phi[_P, columns] = dt**2 / 2 * effect
    phi[_R, _R] = exp_so3(np.array([0.0, 0.0, -path.yaw_rate_radps[row] * dt]))
    phi[_R, _BG] = -dt * np.eye(3)
    return phi


def _process_noise(noise: ImuNoise) -> FloatArray:
    """Return the covariance (23, 23) that a step adds."""
    dt, eye = STEP_S, np.eye(3)
    q = np.zeros((_DIM, _DIM))
    velocity = noise.accelerometer_noise_density**2
    q[_V, _V], q[_P, _P] = velocity * dt * eye, velocity * dt**3 / 3 * eye
    q[_P, _V] = q[_V, _P] = velocity * dt**2 / 2 * eye
    q[_R, _R] = noise.gyro_noise_density**2 * dt * eye
    q[_BG, _BG] = noise.gyro_bias_walk**2 * dt * eye
    q[_BA, _BA] = noise.accelerometer_bias_walk**2 * dt * eye
    return q


def _filter(
    layout: FloatArray,
    stations: Sequence[Station],
    path: DrivenPath,
    imu: ImuParameters,
    steps: Sequence[FloatArray],
    noise: FloatArray,
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the covariances (23, 23) after the measurements at each instant, and before those at each later one.

    ``layout``: relative to the IMU.
    """
    initial = estimation_noise(imu.noise)
    sigmas = np.concatenate(
        [
            _START_SIGMAS,
            np.repeat([initial.gyro_bias_radps, initial.accelerometer_bias_mps2], 3),
            np.repeat(max(imu.tilt_sigma_rad, 1e-6), 2),
            np.repeat(imu.noise.accelerometer_scale_misalignment, 6),
        ]
    )
    covariance = np.diag(sigmas**2)
    filtered, propagated = [], []
    interval = round(1 / (MEASUREMENTS_HZ * STEP_S))
    for row in range(len(path.position_m)):
        if row:
            covariance = steps[row - 1] @ covariance @ steps[row - 1].T + noise
            propagated.append(covariance)
        for number, station in enumerate(stations):
            if row % interval == number * interval // len(stations):
                covariance = _corrected(covariance, layout[station.prism_index], station, path, row)
        filtered.append(covariance)
    return filtered, propagated


def _corrected(
    covariance: FloatArray, prism_m: FloatArray, station: Station, path: DrivenPath, row: int
) -> FloatArray:
    rotation = path.rotation[row]
    jacobian = np.zeros((3, _DIM))
    jacobian[:, _P] = np.eye(3)
    jacobian[:, _R] = -rotation @ skew(prism_m)
    sight = path.position_m[row] + rotation @ prism_m - station.position_m
    innovation = jacobian @ covariance @ jacobian.T
    innovation += measurement_covariance(*cartesian_to_polar(sight), station.noise)
    gain = np.linalg.solve(innovation, jacobian @ covariance).T
    corrected: FloatArray = covariance - gain @ innovation @ gain.T
    return (corrected + corrected.T) / 2


def _smooth(
    filtered: Sequence[FloatArray], propagated: Sequence[FloatArray], steps: Sequence[FloatArray]
) -> list[FloatArray]:
    smoothed = [filtered[-1]]
    for row in range(len(steps) - 1, -1, -1):
        gain = np.linalg.solve(propagated[row], steps[row] @ filtered[row]).T
        smoothed.append(filtered[row] + gain @ (smoothed[-1] - propagated[row]) @ gain.T)
    return smoothed[::-1]


def _propagated(covariance: FloatArray, steps: Sequence[FloatArray], noise: FloatArray) -> FloatArray:
    for step in steps:
        covariance = step @ covariance @ step.T + noise
    return covariance


def _of_point(covariance: FloatArray, rotation: FloatArray, lever: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of a point's position and of the rotation, in the axes of the robot."""
    jacobian = np.zeros((6, _DIM))
    jacobian[:3, _P] = rotation.T
    jacobian[:3, _R] = -lever
    jacobian[3:, _R] = np.eye(3)
    found: FloatArray = jacobian @ covariance @ jacobian.T
    return found
