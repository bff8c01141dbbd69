"""States of an IMU at knots, and what is common to all of them: mounting, gravity, the accelerometer's matrix. Sans-I/O.

The error (local coordinates) of a state has 15 components, three each of: position of the IMU's origin (frame ``station1``),
rotation (about its own axes, ``R Exp(d)``), velocity (``station1``), bias of the gyro (its axes), and bias of the accelerometer
(its axes), or without an accelerometer the acceleration (``station1``). With wheel odometry three more follow: its scale, its
slip, and the direction of travel.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import (
    FloatArray,
    exp_and_right_jacobian,
    exp_so3,
    fast_log_so3,
    rotation_from_quaternion,
    skew,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.model import ImuParameters

INERTIAL_STATE_DIM = 15  # Components of a state's error
WHEELS_DIM = 3  # Further components with wheel odometry
TILT_DIM = 2


@dataclass(frozen=True, slots=True)
class InertialStates:
    """States at K times: the motion of the IMU's origin, the rotation of its axes, and its biases."""

    time_s: FloatArray  # (K,) strictly increasing, from the trajectory's time origin
    position: FloatArray  # (K, 3) in frame ``station1``, m
    rotation: FloatArray  # (K, 3, 3) ``R_station1_imu``
    velocity: FloatArray  # (K, 3) in frame ``station1``, m/s
    gyro_bias: FloatArray  # (K, 3) in the axes of the IMU, rad/s
    # (K, 3) in the axes of the IMU, m/s^2; with the gyro alone: acceleration in frame ``station1``, m/s^2
    bias_or_acceleration: FloatArray
    # (K, 3): scale and slip of the wheel odometry, which add to 1, and direction of travel, rad, positive to the left; (K, 0) without
    wheels: FloatArray

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def dim(self) -> int:
        """Components of a state's error."""
        return INERTIAL_STATE_DIM + int(self.wheels.shape[1])

    def select(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> InertialStates:
        """Return the states of some rows."""
        # Written out: live, a few states are selected thousands of times a minute.
        return InertialStates(
            self.time_s[rows],
            self.position[rows],
            self.rotation[rows],
            self.velocity[rows],
            self.gyro_bias[rows],
            self.bias_or_acceleration[rows],
            self.wheels[rows],
        )

    def with_wheels(self) -> InertialStates:
        """Return the states with wheel odometry that is exact."""
        return replace(self, wheels=np.zeros((len(self), WHEELS_DIM)))

    def retract(self, error: FloatArray) -> InertialStates:
        """Add errors, (K, D), to the states."""
        return InertialStates(
            self.time_s,
            self.position + error[:, 0:3],
            self.rotation @ exp_so3(error[:, 3:6]),
            self.velocity + error[:, 6:9],
            self.gyro_bias + error[:, 9:12],
            self.bias_or_acceleration + error[:, 12:15],
            self.wheels + error[:, 15:],
        )

    def local_coordinates_about(self, other: InertialStates) -> FloatArray:
        """Return the errors d, (K, D), of these states about others: ``other.retract(d)`` gives these states."""
        return np.concatenate(
            [
                self.position - other.position,
                fast_log_so3(other.rotation.swapaxes(1, 2) @ self.rotation),
                self.velocity - other.velocity,
                self.gyro_bias - other.gyro_bias,
                self.bias_or_acceleration - other.bias_or_acceleration,
                self.wheels - other.wheels,
            ],
            axis=1,
        )


def concatenate_inertial_states(parts: list[InertialStates]) -> InertialStates:
    """Concatenate states in the given order."""
    return InertialStates(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in InertialStates.__slots__)
    )


@dataclass(frozen=True, slots=True)
class Mounting:
    """Where the IMU sits on the robot. Prisms and other points of the robot enter through it alone."""

    rotation: FloatArray  # (3, 3) ``R_robot_imu``
    position: (
        FloatArray  # (3,) its origin, from the reference point of the layout in the axes of the robot, m
    )

    @classmethod
    def of(cls, imu: ImuParameters, reference_m: FloatArray) -> Mounting:
        """Return the mounting relative to a reference point, (3,) in the robot frame: the origin of the layout's points."""
        return cls(
            rotation_from_quaternion(np.array(imu.orientation_xyzw)),
            np.array(imu.position_m) - reference_m,
        )

    def in_imu(self, points: FloatArray) -> FloatArray:
        """Points of the robot, (..., 3) from the reference point in its axes, from the IMU's origin in the IMU's axes."""
        moved: FloatArray = (points - self.position) @ self.rotation
        return moved


@dataclass(frozen=True, slots=True)
class Gravity:
    """Gravity in frame ``station1``, and how the accelerometer measures against it: what all states share.

    The z axis of ``station1`` is vertical up to a tilt. The accelerometer measures a force along each of H directions, those across
    the vertical, with an error in proportion to it: its scale and the alignment of its axes. Along the vertical, where the force hardly
    changes, that error is part of the bias. The error (local coordinates) has 2 + 3 H components: of tilt and ``matrix``.
    """

    magnitude_mps2: float
    tilt_sigma_rad: float  # One sigma of each component of the tilt
    # (2,) rotation vector about the axes x and y of ``station1`` that takes its z axis to the vertical, rad
    tilt: FloatArray
    # (3, H) what a unit force along each direction adds to what is measured, in the axes of the IMU
    matrix: FloatArray = field(default_factory=lambda: np.zeros((3, 0)))
    directions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (H, 3) unit vectors
    matrix_sigma: float = 0.0  # One sigma of each component of that matrix

    @classmethod
    def of(cls, imu: ImuParameters) -> Gravity:
        """Return gravity along the z axis."""
        return cls(imu.gravity_mps2, imu.tilt_sigma_rad, np.zeros(TILT_DIM))

    def with_matrix(self, sigma: float, vertical: FloatArray) -> Gravity:
        """Return it with an unknown matrix; ``vertical``: (3,) the robot's z axis in the axes of the IMU."""
        first = np.cross(np.eye(3)[int(np.argmin(np.abs(vertical)))], vertical)
        first /= np.linalg.norm(first)
        directions = np.stack([first, np.cross(vertical, first)])
        return replace(self, matrix=np.zeros((3, 2)), directions=directions, matrix_sigma=sigma)

    @property
    def dim(self) -> int:
        """Components of an error."""
        return TILT_DIM + int(self.matrix.size)

    @property
    def shared(self) -> FloatArray:
        """(S,) tilt and matrix: the error about zero."""
        return np.concatenate([self.tilt, self.matrix.ravel()])

    def retract(self, error: FloatArray) -> Gravity:
        """Add an error, (S,)."""
        matrix = self.matrix + error[TILT_DIM:].reshape(self.matrix.shape)
        return replace(self, tilt=self.tilt + error[:TILT_DIM], matrix=matrix)

    def prior_sigmas(self) -> FloatArray:
        """(S,) one sigma of each component of the error."""
        of_tilt = np.full(TILT_DIM, max(self.tilt_sigma_rad, 1e-9))
        return np.concatenate([of_tilt, np.full(self.matrix.size, max(self.matrix_sigma, 1e-9))])

    def force_error(self, force: FloatArray) -> FloatArray:
        """Return what the matrix adds to specific forces, (K, 3) each, like a bias."""
        found: FloatArray = (force @ self.directions.T) @ self.matrix.T
        return found

    def by_matrix(self, by_bias: FloatArray, force: FloatArray) -> FloatArray:
        """(K, N, 3 H) Jacobian by the matrix from that by the accelerometer's bias, (K, N, 3), and the specific forces, (K, 3)."""
        along = force @ self.directions.T
        found = by_bias[:, :, :, None] * along[:, None, None, :]
        return found.reshape(*by_bias.shape[:2], self.matrix.size)

    def vector(self) -> FloatArray:
        """(3,) acceleration of a falling body in frame ``station1``, m/s^2."""
        return _falling(self.magnitude_mps2, self.tilt.tobytes())[0]

    def by_tilt(self) -> FloatArray:
        """(3, 2) Jacobian of that vector by the tilt."""
        return _falling(self.magnitude_mps2, self.tilt.tobytes())[1]


@lru_cache(maxsize=16)
def _falling(magnitude_mps2: float, tilt: bytes) -> tuple[FloatArray, FloatArray]:
    """(3,) acceleration of a falling body, and its (3, 2) Jacobian by the tilt; each step of a solver asks several times."""
    rotation, J_r = exp_and_right_jacobian(np.append(np.frombuffer(tilt), 0.0))
    down = np.array([0.0, 0.0, -magnitude_mps2])
    found = rotation @ down, -(rotation @ skew(down) @ J_r)[:, :TILT_DIM]
    for each in found:
        each.flags.writeable = False
    return found
