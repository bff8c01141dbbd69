"""What a drive has told of an IMU's set-up, component by component, and what it has left to the prior. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial_calibration.calibration import UNCALIBRATED
from tsgt.geometry.inertial_calibration.setup import (
    GYRO_MATRIX,
    LATENCY,
    POSITION,
    ROTATION,
    gyro_directions,
)

if TYPE_CHECKING:
    from tsgt.geometry.inertial_calibration.calibration import ImuCalibration
    from tsgt.geometry.rigid import FloatArray

ROTATION_LIMIT_RAD = math.radians(0.15)
POSITION_LIMIT_M = 0.01
LATENCY_LIMIT_S = 0.001
"""One sigma beyond which a component counts as undetermined: more harms the poses."""

MAX_SHARE_OF_PRIOR = 0.5  # Of the sigma of a component of the gyro matrix

MIN_FREE_SHARE = (
    0.2  # Of the prior sigma that is left to an entry of the matrix by the definition of the axes
)

_MATRIX_ENTRIES = [
    *((f"scale of the gyro's {'xyz'[axis]}", axis, axis) for axis in range(3)),
    *(
        (f"cross-axis sensitivity of the gyro's {'xyz'[row]} to {'xyz'[column]}", row, column)
        for row in range(3)
        for column in range(3)
        if row != column
    ),
]

_ADVICE = {
    "rotation": "accelerate, brake and turn more",
    "position": "turn on the spot and, for its height, drive over slopes and bumps",
    "latency": "change speed and direction more often",
    "gyro": "drive over slopes and bumps, so that the robot rolls and pitches",
}


@dataclass(frozen=True, slots=True)
class SetupComponent:
    """One component of the set-up."""

    name: str
    sigma: float  # rad, m, s, or 1
    prior_sigma: float
    determined: bool
    advice: str  # What to drive if it is not determined


def setup_components(calibration: ImuCalibration) -> list[SetupComponent]:
    """Components of rotation and position along the axes of the robot, latency, and gyro matrix."""
    sigmas, prior = calibration.sigmas, calibration.prior.sigmas
    rotation = calibration.setup.mounting.rotation
    about_robot = rotation @ calibration.covariance[ROTATION, ROTATION] @ rotation.T
    found = []
    for kind, words, values, priors, limit in (
        ("rotation", "rotation about", np.sqrt(np.diag(about_robot)), prior[ROTATION], ROTATION_LIMIT_RAD),
        ("position", "position along", sigmas[POSITION], prior[POSITION], POSITION_LIMIT_M),
    ):
        for axis, value, before in zip("xyz", values.tolist(), priors.tolist(), strict=True):
            found.append(
                SetupComponent(f"{words} the robot's {axis}", value, before, value < limit, _ADVICE[kind])
            )
    latency_s = float(sigmas[LATENCY])
    found.append(
        SetupComponent(
            "latency", latency_s, float(prior[LATENCY]), latency_s < LATENCY_LIMIT_S, _ADVICE["latency"]
        )
    )
    # What the factory has calibrated needs no motion.
    trusted = calibration.matrix_sigma < UNCALIBRATED
    directions = gyro_directions(calibration.setup.vertical)
    by_entry = directions.reshape(len(directions), 9).T
    of_matrix = by_entry @ calibration.covariance[GYRO_MATRIX, GYRO_MATRIX] @ by_entry.T
    values = np.sqrt(np.diag(of_matrix)).reshape(3, 3)
    priors = np.linalg.norm(by_entry * prior[GYRO_MATRIX], axis=1).reshape(3, 3)
    for name, row, column in _MATRIX_ENTRIES:
        value, before = float(values[row, column]), float(priors[row, column])
        if before < MIN_FREE_SHARE * calibration.matrix_sigma:
            continue  # Defined by the axes
        determined = trusted or value < MAX_SHARE_OF_PRIOR * before
        found.append(SetupComponent(name, value, before, determined, _ADVICE["gyro"]))
    return found


def robot_covariance(calibration: ImuCalibration) -> FloatArray:
    """(16, 16) of position (robot frame), rotation (about the axes of the robot), latency, and gyro matrix, row by row."""
    setup = calibration.setup
    jacobian = np.zeros((16, setup.dim))
    jacobian[0:3, POSITION] = np.eye(3)
    jacobian[3:6, ROTATION] = setup.mounting.rotation
    jacobian[6, LATENCY] = 1.0
    jacobian[7:16, GYRO_MATRIX] = gyro_directions(setup.vertical).reshape(7, 9).T
    covariance = jacobian @ calibration.covariance @ jacobian.T
    return np.asarray(0.5 * (covariance + covariance.T))
