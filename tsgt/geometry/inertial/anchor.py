"""Prior on the first knot of a trajectory with an IMU: what is known from before it. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import FloatArray, cross, inverse_right_jacobian, matvec, skew

if TYPE_CHECKING:
    from tsgt.geometry.inertial.states import InertialStates

_POSITION, _ROTATION, _VELOCITY, _GYRO_BIAS = (slice(3 * i, 3 * i + 3) for i in range(4))


@dataclass(frozen=True, slots=True)
class InertialAnchor:
    """Gaussian prior on the first knot and on what all knots share, which may be correlated.

    Its error is that of the states (``states.InertialStates``), except that position and velocity are those of a point of the
    robot. Of one that a prism measures, they are known whatever the rotation and the bias of the gyro: with those of the IMU's
    origin, millimetres that are known at one heading would tell the heading itself once that has moved by some degrees.
    """

    linearisation_point: InertialStates  # One knot about which the error is counted
    shared: FloatArray  # (S,) likewise
    information: FloatArray  # (D + S, D + S) inverse covariance of the errors
    mean: FloatArray  # (D + S,) of the errors
    point: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,) the point, from the IMU's origin in its axes."""
    rate: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,) angular rate at the knot, rad/s, the gyro's bias included."""

    @classmethod
    def at_point(
        cls,
        linearisation_point: InertialStates,
        shared: FloatArray,
        information: FloatArray,
        mean: FloatArray,
        point: FloatArray,
        rate: FloatArray,
    ) -> InertialAnchor:
        """Return the prior from information and mean of the error with position and velocity of the IMU's origin."""
        by_error = _by_state(linearisation_point, point, rate, len(mean))
        inverse = 2.0 * np.eye(len(mean)) - by_error
        return cls(
            linearisation_point, shared, inverse.T @ information @ inverse, by_error @ mean, point, rate
        )

    def errors(self, first: InertialStates, shared: FloatArray) -> FloatArray:
        """(N, D + S) differences from the mean, of N first knots and what their trajectories share, (N, S)."""
        about = self.linearisation_point
        found = first.local_coordinates_about(about)
        found[:, _POSITION] += (first.rotation - about.rotation) @ self.point
        found[:, _VELOCITY] += _velocity(first, self.point, self.rate) - _velocity(
            about, self.point, self.rate
        )
        return np.concatenate([found, shared - self.shared], axis=1) - self.mean

    def jacobian(self, first: InertialStates, error: FloatArray) -> FloatArray:
        """(D + S, D + S) Jacobian of an error, (D + S,), by that of the states of its first knot and what all share."""
        found = _by_state(first, self.point, self.rate, len(error))
        found[_ROTATION, _ROTATION] = inverse_right_jacobian((error + self.mean)[_ROTATION])
        return found

    def weighted_displacement(self, displacement: FloatArray) -> FloatArray:
        """(D + S, r) information times the displacement of the states that are the mean, (D + S, r); both of the IMU's origin."""
        by_error = _by_state(self.linearisation_point, self.point, self.rate, len(displacement))
        return by_error.T @ self.information @ by_error @ displacement


def _velocity(states: InertialStates, point: FloatArray, rate: FloatArray) -> FloatArray:
    """(K, 3) velocity of a point in addition to that of the IMU's origin."""
    return matvec(states.rotation, cross(rate - states.gyro_bias, point))


def _by_state(first: InertialStates, point: FloatArray, rate: FloatArray, size: int) -> FloatArray:
    """(D + S, D + S) Jacobian of the error about a point by that about the IMU's origin, for small rotations from one to the other."""
    rotation = first.rotation[0]
    found = np.eye(size)
    found[_VELOCITY, _GYRO_BIAS] = by_turning = rotation @ skew(point)
    found[_POSITION, _ROTATION] = -by_turning
    found[_VELOCITY, _ROTATION] = -rotation @ skew(cross(rate - first.gyro_bias[0], point))
    return found
