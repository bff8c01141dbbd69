"""Set-up of an IMU: what its calibration estimates, and the prior. Sans-I/O.

The parameters of an error have these components: rotation of the mounting (about the IMU's own axes, ``R Exp(d)``), position of
its origin (robot frame), latency, gyro matrix, accelerometer matrix, and the delay of each station's times.

A rotation of the gyro's axes cannot be told from one of the mounting, so that the gyro matrix has six free components, which
defines the axes of the IMU: its main axis, that nearest to the z axis of the robot, is the gyro's, and the other two deviate from the
gyro's alike. The motion determines that mounting best. The accelerometer's matrix, which has nine components then, and the delays
are estimated for the sake of the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial import Mounting
from tsgt.geometry.rigid import exp_so3, log_so3

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray

ROTATION, POSITION, LATENCY = slice(0, 3), slice(3, 6), 6
GYRO_MATRIX, ACCELEROMETER_MATRIX, DELAYS = slice(7, 13), slice(13, 22), slice(22, None)
MOUNTING_DIM = 7  # Rotation, position and latency

ROTATION_SIGMA_RAD = 1.0
POSITION_SIGMA_M = 1.0
LATENCY_SIGMA_S = 1.0
DELAY_SIGMA_S = 5e-4
"""One sigma of a station's mean time: its instrument's clock is fitted to half a millisecond (docs/explanation/instrument-time.md)."""


def gyro_directions(main_axis: int) -> FloatArray:
    """(6, 3, 3) free components of the gyro matrix: three scale factors and three of misalignment."""
    i, j = (axis for axis in range(3) if axis != main_axis)
    directions = np.zeros((6, 3, 3))
    directions[np.arange(3), np.arange(3), np.arange(3)] = 1.0
    directions[3, i, j] = directions[3, j, i] = 1.0
    directions[4, main_axis, i] = directions[5, main_axis, j] = 1.0
    return directions


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
            self.accelerometer_matrix + error[ACCELEROMETER_MATRIX].reshape(3, 3),
            self.delays_s + error[DELAYS],
            self.main_axis,
        )

    def local_coordinates_about(self, other: ImuSetup) -> FloatArray:
        """Return the error of this set-up about another one: ``other.retract(error)`` is this one."""
        directions = gyro_directions(self.main_axis)
        by_gyro = np.einsum("ijk,jk->i", directions, self.gyro_matrix - other.gyro_matrix)
        return np.concatenate(
            [
                log_so3(other.mounting.rotation.T @ self.mounting.rotation),
                self.mounting.position - other.mounting.position,
                [self.latency_s - other.latency_s],
                by_gyro / directions.sum(axis=(1, 2)),
                (self.accelerometer_matrix - other.accelerometer_matrix).ravel(),
                self.delays_s - other.delays_s,
            ]
        )


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


def in_main_axes(
    rotation: FloatArray, gyro_matrix: FloatArray, main_axis: int
) -> tuple[FloatArray, FloatArray]:
    """Mounting and gyro matrix, (3, 3) each, that take samples to the same rates of the robot, in the axes defined above."""
    i, j = (axis for axis in range(3) if axis != main_axis)
    main = np.eye(3)[main_axis]
    direction = gyro_matrix[:, main_axis] / np.linalg.norm(gyro_matrix[:, main_axis])
    turn = exp_so3(np.cross(main, direction))
    turn = turn @ exp_so3(np.cross(main, turn.T @ direction))
    aligned = turn.T @ gyro_matrix
    sign = (
        1.0 if (j - i) == 1 else -1.0
    )  # The axes i, j and the main one are right-handed, but for 0, 2 and 1
    angle = np.arctan2(aligned[j, i] - aligned[i, j], aligned[i, i] + aligned[j, j])
    turn = turn @ exp_so3(sign * angle * main)
    return rotation @ turn, turn.T @ gyro_matrix
