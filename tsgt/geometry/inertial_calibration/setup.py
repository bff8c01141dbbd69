"""Set-up of an IMU: what its calibration estimates, and the prior. Sans-I/O.

The parameters of an error have these components: rotation of the mounting (about the IMU's own axes, ``R Exp(d)``), position of
its origin (robot frame), latency, gyro matrix, accelerometer matrix, and the delay of each station's times.

A rotation of the axes of gyro and accelerometer together cannot be told from one of the mounting, so that both matrices have three
components less. The axes of the IMU are defined by what the motion of a vehicle determines best: the direction that is vertical when
the robot stands level is the gyro's, and about it the axes are turned as those of the accelerometer are on average. The accelerometer's
matrix and the delays are estimated for the sake of the others.
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
GYRO_MATRIX, ACCELEROMETER_MATRIX, DELAYS = slice(7, 14), slice(14, 22), slice(22, None)
POSE_AND_LATENCY_DIM = 7  # Rotation, position and latency

ROTATION_SIGMA_RAD = 1.0
POSITION_SIGMA_M = 1.0
LATENCY_SIGMA_S = 1.0
DELAY_SIGMA_S = 5e-4
"""One sigma of a station's mean time: its instrument's clock is fitted to half a millisecond (docs/explanation/instrument-time.md)."""


def gyro_directions(vertical: FloatArray) -> FloatArray:
    """(7, 3, 3) orthonormal free components of the gyro matrix: a rate about the vertical stays one."""
    frame = axes_about(vertical)
    products = frame[:, None, :, None] * frame[None, :, None, :]
    return np.stack([products[i, j] for i in range(3) for j in range(3) if (i, j) not in {(0, 2), (1, 2)}])


def accelerometer_directions(vertical: FloatArray) -> FloatArray:
    """(8, 3, 3) orthonormal free components of the accelerometer's matrix: it does not turn about the vertical."""
    frame = axes_about(vertical)
    products = frame[:, None, :, None] * frame[None, :, None, :]
    others = [products[i, j] for i in range(3) for j in range(3) if (i, j) not in {(0, 1), (1, 0)}]
    return np.stack([*others, (products[0, 1] + products[1, 0]) / np.sqrt(2.0)])


def axes_about(vertical: FloatArray) -> FloatArray:
    """(3, 3) right-handed orthonormal vectors, one per row; the last is the vertical."""
    first = np.cross(np.eye(3)[(int(np.argmax(np.abs(vertical))) + 1) % 3], vertical)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(vertical, first), vertical])


@dataclass(frozen=True, slots=True)
class ImuSetup:
    """How an IMU is mounted, and how its samples become angular rates and specific forces at an instant."""

    mounting: Mounting  # From the reference point of the layout
    latency_s: float  # From a sample to its stamp
    gyro_matrix: FloatArray  # (3, 3) the angular rate is this times the sample, less the bias
    accelerometer_matrix: FloatArray  # (3, 3) likewise
    delays_s: FloatArray  # (S,) by which the times of a station's measurements are early
    vertical: (
        FloatArray  # (3,) unit vector near the robot's z axis, in the axes of the IMU, that defines these
    )

    @classmethod
    def initial(cls, mounting: Mounting, latency_s: float, stations: int) -> ImuSetup:
        """Return a set-up without errors of scale and alignment."""
        return cls(mounting, latency_s, np.eye(3), np.eye(3), np.zeros(stations), mounting.rotation[2].copy())

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
            self.gyro_matrix + np.einsum("i,ijk->jk", error[GYRO_MATRIX], gyro_directions(self.vertical)),
            self.accelerometer_matrix
            + np.einsum("i,ijk->jk", error[ACCELEROMETER_MATRIX], accelerometer_directions(self.vertical)),
            self.delays_s + error[DELAYS],
            self.vertical,
        )

    def local_coordinates_about(self, other: ImuSetup) -> FloatArray:
        """Return the error of this set-up about another one: ``other.retract(error)`` is this one."""
        return np.concatenate(
            [
                log_so3(other.mounting.rotation.T @ self.mounting.rotation),
                self.mounting.position - other.mounting.position,
                [self.latency_s - other.latency_s],
                _components(gyro_directions(self.vertical), self.gyro_matrix - other.gyro_matrix),
                _components(
                    accelerometer_directions(self.vertical),
                    self.accelerometer_matrix - other.accelerometer_matrix,
                ),
                self.delays_s - other.delays_s,
            ]
        )


def gyro_rotation(setup: ImuSetup) -> FloatArray:
    """(3, D) Jacobian of the rotation of the gyro's axes, the average of the three, by the error of a set-up."""
    jacobian = np.zeros((3, setup.dim))
    jacobian[:, ROTATION] = np.eye(3)
    first, second, vertical = axes_about(setup.vertical)
    directions = gyro_directions(setup.vertical)
    jacobian[:, GYRO_MATRIX] = 0.5 * np.outer(
        vertical, second @ directions @ first - first @ directions @ second
    )
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
    found: FloatArray = np.einsum("ijk,jk->i", directions, matrix)
    return found
