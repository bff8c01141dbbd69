"""States of an IMU at knots, and what is common to all of them: mounting and gravity. Sans-I/O.

The error (local coordinates) of a state has 15 components, three each of: position of the IMU's origin (frame ``station1``),
rotation (about its own axes, ``R Exp(d)``), velocity (``station1``), bias of the gyro (its axes), and bias of the accelerometer
(its axes), or without an accelerometer the acceleration (``station1``). With wheel odometry three more follow: its scale, its
slip, and the direction of travel.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
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
        return InertialStates(*(getattr(self, each.name)[rows] for each in fields(self)))

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
                fast_log_so3(np.swapaxes(other.rotation, 1, 2) @ self.rotation),
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
        *(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(InertialStates))
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
    """Gravity in frame ``station1``, whose z axis is vertical up to a tilt that all states share."""

    magnitude_mps2: float
    tilt_sigma_rad: float  # One sigma of each component of the tilt
    # (2,) rotation vector about the axes x and y of ``station1`` that takes its z axis to the vertical, rad
    tilt: FloatArray

    @classmethod
    def of(cls, imu: ImuParameters) -> Gravity:
        """Return gravity along the z axis."""
        return cls(imu.gravity_mps2, imu.tilt_sigma_rad, np.zeros(TILT_DIM))

    def vector(self) -> FloatArray:
        """(3,) acceleration of a falling body in frame ``station1``, m/s^2."""
        return self._with_jacobian()[0]

    def by_tilt(self) -> FloatArray:
        """(3, 2) Jacobian of that vector by the tilt."""
        return self._with_jacobian()[1]

    def _with_jacobian(self) -> tuple[FloatArray, FloatArray]:
        rotation, J_r = exp_and_right_jacobian(np.append(self.tilt, 0.0))
        down = np.array([0.0, 0.0, -self.magnitude_mps2])
        return rotation @ down, -(rotation @ skew(down) @ J_r)[:, :TILT_DIM]
