"""Set-up of an IMU: what its calibration estimates, and the prior. Sans-I/O.

The parameters of an error have these components: rotation of the mounting (about the IMU's own axes, ``R Exp(d)``), position of
its origin (robot frame), latency, gyro matrix, accelerometer matrix, and the delay of each station's times.

The gyro matrix is symmetric, which defines the axes of the IMU: its other three components cannot be told from a rotation of the
mounting. The accelerometer's matrix, which need not be symmetric then, and the delays are estimated for the sake of the others.
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

SYMMETRIC = np.zeros((6, 3, 3))
"""Directions of a symmetric matrix: its diagonal, then the elements xy, xz, yz."""
for _row, (_i, _j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
    SYMMETRIC[_row, _i, _j] = SYMMETRIC[_row, _j, _i] = 1.0

ROTATION_SIGMA_RAD = 1.0
POSITION_SIGMA_M = 1.0
LATENCY_SIGMA_S = 1.0
DELAY_SIGMA_S = 5e-4
"""One sigma of a station's mean time: its instrument's clock is fitted to half a millisecond (docs/explanation/instrument-time.md)."""


@dataclass(frozen=True, slots=True)
class ImuSetup:
    """How an IMU is mounted, and how its samples become angular rates and specific forces at an instant."""

    mounting: Mounting  # From the reference point of the layout
    latency_s: float  # From a sample to its stamp
    gyro_matrix: FloatArray  # (3, 3) symmetric; the angular rate is this times the sample, less the bias
    accelerometer_matrix: FloatArray  # (3, 3) likewise
    delays_s: FloatArray  # (S,) by which the times of a station's measurements are early

    @classmethod
    def initial(cls, mounting: Mounting, latency_s: float, stations: int) -> ImuSetup:
        """Return a set-up without errors of scale and alignment."""
        return cls(mounting, latency_s, np.eye(3), np.eye(3), np.zeros(stations))

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
            self.gyro_matrix + np.einsum("i,ijk->jk", error[GYRO_MATRIX], SYMMETRIC),
            self.accelerometer_matrix + error[ACCELEROMETER_MATRIX].reshape(3, 3),
            self.delays_s + error[DELAYS],
        )

    def local_coordinates_about(self, other: ImuSetup) -> FloatArray:
        """Return the error of this set-up about another one: ``other.retract(error)`` is this one."""
        by_gyro = self.gyro_matrix - other.gyro_matrix
        return np.concatenate(
            [
                log_so3(other.mounting.rotation.T @ self.mounting.rotation),
                self.mounting.position - other.mounting.position,
                [self.latency_s - other.latency_s],
                np.diag(by_gyro),
                by_gyro[np.triu_indices(3, 1)],
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
        # An off-diagonal element of a symmetric matrix is the mean of two.
        sigmas[GYRO_MATRIX.start + 3 : GYRO_MATRIX.stop] /= np.sqrt(2.0)
        return cls(mean, sigmas)


def symmetric_gauge(rotation: FloatArray, gyro_matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mounting and gyro matrix, (3, 3) each, that take samples to the same rates of the robot, the matrix symmetric."""
    left, stretch, right = np.linalg.svd(gyro_matrix)
    symmetric = right.T @ np.diag(stretch) @ right
    turned: FloatArray = rotation @ left @ right
    return turned, 0.5 * (symmetric + symmetric.T)
