"""Set-up of an IMU: what its calibration estimates, and the prior. Sans-I/O.

The parameters of an error have these components: rotation of the mounting (about the IMU's own axes, ``R Exp(d)``), position of
its origin (robot frame), latency, gyro matrix, accelerometer matrix, and the delay of each station's times.

A rotation of the axes of gyro and accelerometer together cannot be told from one of the mounting, so that both matrices have three
components less. The axes of the IMU are defined by what the motion determines best: its main axis, that nearest to the robot's z
axis, is the gyro's, and about it the axes are turned as those of the accelerometer are on average. The accelerometer's matrix and
the delays are estimated for the sake of the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial import Mounting
from tsgt.geometry.rigid import exp_so3, log_so3

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray

ROTATION, POSITION, LATENCY = slice(0, 3), slice(3, 6), 6
GYRO_MATRIX, ACCELEROMETER_MATRIX, DELAYS = slice(7, 14), slice(14, 22), slice(22, None)
MOUNTING_DIM = 7  # Rotation, position and latency

ROTATION_SIGMA_RAD = 1.0
POSITION_SIGMA_M = 1.0
LATENCY_SIGMA_S = 1.0
DELAY_SIGMA_S = 5e-4
"""One sigma of a station's mean time: its instrument's clock is fitted to half a millisecond (docs/explanation/instrument-time.md)."""


def gyro_directions(main_axis: int) -> FloatArray:
    """(7, 3, 3) free components of the gyro matrix: three scale factors and four of misalignment."""
    i, j = other_axes(main_axis)
    directions = np.zeros((7, 3, 3))
    directions[np.arange(3), np.arange(3), np.arange(3)] = 1.0
    directions[3, i, j] = directions[4, j, i] = 1.0
    directions[5, main_axis, i] = directions[6, main_axis, j] = 1.0
    return directions


def accelerometer_directions(main_axis: int) -> FloatArray:
    """(8, 3, 3) free components of the accelerometer's matrix: it is symmetric in the axes other than the main one."""
    i, j = other_axes(main_axis)
    entries = [(row, column) for row in range(3) for column in range(3) if (row, column) != (j, i)]
    directions = np.zeros((8, 3, 3))
    for direction, entry in zip(directions, entries, strict=True):
        direction[entry] = 1.0
        if entry == (i, j):
            direction[j, i] = 1.0
    return directions


def other_axes(main_axis: int) -> tuple[int, int]:
    """Return the two axes beside the main one, such that they and the main axis are right-handed."""
    return (main_axis + 1) % 3, (main_axis + 2) % 3


@dataclass(frozen=True, slots=True)
class ImuSetup:
    """How an IMU is mounted, and how its samples become angular rates and specific forces at an instant."""

    mounting: Mounting  # From the reference point of the layout
    latency_s: float  # From a sample to its stamp
    gyro_matrix: FloatArray  # (3, 3) the angular rate is this times the sample, less the bias
    accelerometer_matrix: FloatArray  # (3, 3) likewise
    delays_s: FloatArray  # (S,) by which the times of a station's measurements are early
    main_axis: int  # 0 to 2

    @classmethod
    def initial(cls, mounting: Mounting, latency_s: float, stations: int) -> ImuSetup:
        """Return a set-up without errors of scale and alignment; the main axis is that nearest to the robot's z axis."""
        main_axis = int(np.argmax(np.abs(mounting.rotation[2])))
        return cls(mounting, latency_s, np.eye(3), np.eye(3), np.zeros(stations), main_axis)

    @property
    def dim(self) -> int:
        """Number of components of an error."""
        return 22 + len(self.delays_s)

    def retract(self, error: FloatArray) -> ImuSetup:
        """Add an error."""
        return ImuSetup(
            Mounting(
                self.mounting.rotation @ exp_so3(error[ROTATION]), self.mounting.position + error[POSITION]
            ),
            self.latency_s + float(error[LATENCY]),
            self.gyro_matrix + np.einsum("i,ijk->jk", error[GYRO_MATRIX], gyro_directions(self.main_axis)),
            self.accelerometer_matrix
            + np.einsum("i,ijk->jk", error[ACCELEROMETER_MATRIX], accelerometer_directions(self.main_axis)),
            self.delays_s + error[DELAYS],
            self.main_axis,
        )

    def local_coordinates_about(self, other: ImuSetup) -> FloatArray:
        """Return the error of this set-up about another one: ``other.retract(error)`` is this one."""
        return np.concatenate(
            [
                log_so3(other.mounting.rotation.T @ self.mounting.rotation),
                self.mounting.position - other.mounting.position,
                [self.latency_s - other.latency_s],
                _components(gyro_directions(self.main_axis), self.gyro_matrix - other.gyro_matrix),
                _components(
                    accelerometer_directions(self.main_axis),
                    self.accelerometer_matrix - other.accelerometer_matrix,
                ),
                self.delays_s - other.delays_s,
            ]
        )


def gyro_rotation(setup: ImuSetup) -> FloatArray:
    """(3, D) Jacobian of the rotation of the gyro's axes, the average of the three, by the error of a set-up."""
    i, j = other_axes(setup.main_axis)
    jacobian = np.zeros((3, setup.dim))
    jacobian[:, ROTATION] = np.eye(3)
    directions = gyro_directions(setup.main_axis)
    jacobian[setup.main_axis, GYRO_MATRIX] = 0.5 * (directions[:, j, i] - directions[:, i, j])
    return jacobian


@dataclass(frozen=True, slots=True)
class SetupPrior:
    """Gaussian prior on a set-up: independent components."""

    mean: ImuSetup
    sigmas: FloatArray  # (D,)

    @classmethod
    def wide(cls, mean: ImuSetup, matrix_sigma: float) -> SetupPrior:
        """Return the prior of a calibration: nothing is known but how good such IMUs are, and the stations' times."""
        sigmas = np.empty(mean.dim)
        sigmas[ROTATION], sigmas[POSITION] = ROTATION_SIGMA_RAD, POSITION_SIGMA_M
        sigmas[LATENCY], sigmas[DELAYS] = LATENCY_SIGMA_S, DELAY_SIGMA_S
        sigmas[GYRO_MATRIX] = sigmas[ACCELEROMETER_MATRIX] = matrix_sigma
        return cls(mean, sigmas)


def _components(directions: FloatArray, matrix: FloatArray) -> FloatArray:
    found: FloatArray = np.einsum("ijk,jk->i", directions, matrix) / directions.sum(axis=(1, 2))
    return found


def in_main_axes(setup: ImuSetup) -> ImuSetup:
    """Return a set-up that takes samples to the same rates and forces of the robot, in the axes defined above."""
    i, j = other_axes(setup.main_axis)
    main = np.eye(3)[setup.main_axis]
    direction = setup.gyro_matrix[:, setup.main_axis]
    direction = direction / np.linalg.norm(direction)
    turn = exp_so3(np.cross(main, direction))
    turn = turn @ exp_so3(np.cross(main, turn.T @ direction))
    aligned = turn.T @ setup.accelerometer_matrix
    angle = np.arctan2(aligned[j, i] - aligned[i, j], aligned[i, i] + aligned[j, j])
    turn = turn @ exp_so3(angle * main)
    return replace(
        setup,
        mounting=Mounting(setup.mounting.rotation @ turn, setup.mounting.position),
        gyro_matrix=turn.T @ setup.gyro_matrix,
        accelerometer_matrix=turn.T @ setup.accelerometer_matrix,
    )
