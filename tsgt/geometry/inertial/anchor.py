"""Prior on the first knot of a trajectory with an IMU: what is known from before it. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import FloatArray, cross, inverse_right_jacobian, matvec, skew

if TYPE_CHECKING:
    from tsgt.geometry.inertial.states import InertialStates

_POSITION, _ROTATION, _VELOCITY, _GYRO_BIAS, _FORCE_BIAS = (slice(3 * i, 3 * i + 3) for i in range(5))


@dataclass(frozen=True, slots=True)
class InertialAnchor:
    """Gaussian prior on the first knot and on what all knots share, which may be correlated.

    Its error is that of the states (``states.InertialStates``), except that position and velocity are those of a point of the
    robot. Of one that a prism measures, they are known whatever the rotation and the bias of the gyro: with those of the IMU's
    origin, millimetres that are known at one heading would tell the heading itself once that has moved by some degrees.

    Likewise the bias of the accelerometer is stated by what it leaves of gravity: while a robot stands, that is known whatever its
    rotation about the line of two prisms, on which the bias itself depends.
    """

    linearisation_point: InertialStates  # One knot about which the error is counted
    shared: FloatArray  # (S,) likewise
    information: FloatArray  # (D + S, D + S) inverse covariance of the errors
    mean: FloatArray  # (D + S,) of the errors
    point: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,) the point, from the IMU's origin in its axes."""
    rate: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,) angular rate at the knot, rad/s, the gyro's bias included."""
    fall: FloatArray | None = None
    """(3,) acceleration of a falling body in frame ``station1``, m/s^2; None: the error is that of the bias itself."""

    @classmethod
    def at_point(
        cls,
        linearisation_point: InertialStates,
        shared: FloatArray,
        information: FloatArray,
        mean: FloatArray,
        point: FloatArray,
        rate: FloatArray,
        fall: FloatArray | None,
    ) -> InertialAnchor:
        """Return the prior from information and mean of the error with position and velocity of the IMU's origin."""
        prior = cls(linearisation_point, shared, information, mean, point, rate, fall)
        by_error = prior._by_state(linearisation_point)
        inverse = 2.0 * np.eye(len(mean)) - by_error
        return replace(prior, information=inverse.T @ information @ inverse, mean=by_error @ mean)

    def errors(self, first: InertialStates, shared: FloatArray) -> FloatArray:
        """(N, D + S) differences from the mean, of N first knots and what their trajectories share, (N, S)."""
        about = self.linearisation_point
        found = first.local_coordinates_about(about)
        found[:, _POSITION] += (first.rotation - about.rotation) @ self.point
        found[:, _VELOCITY] += _velocity(first, self.point, self.rate) - _velocity(
            about, self.point, self.rate
        )
        if self.fall is not None:
            fall = about.rotation[0].T @ self.fall
            turned = about.rotation[0].T @ first.rotation
            found[:, _FORCE_BIAS] = matvec(turned, fall + found[:, _FORCE_BIAS]) - fall
        return np.concatenate([found, shared - self.shared], axis=1) - self.mean

    def jacobian(self, first: InertialStates, error: FloatArray) -> FloatArray:
        """(D + S, D + S) Jacobian of an error, (D + S,), by that of the states of its first knot and what all share."""
        found = self._by_state(first)
        found[_ROTATION, _ROTATION] = inverse_right_jacobian((error + self.mean)[_ROTATION])
        return found

    def weighted_displacement(self, displacement: FloatArray) -> FloatArray:
        """(D + S, r) information times the displacement of the states that are the mean, (D + S, r); both of the IMU's origin."""
        by_error = self._by_state(self.linearisation_point)
        return by_error.T @ self.information @ by_error @ displacement

    def _by_state(self, first: InertialStates) -> FloatArray:
        """(D + S, D + S) Jacobian of the error by that of the states, for small rotations from the linearisation point."""
        rotation = first.rotation[0]
        found = np.eye(len(self.mean))
        found[_VELOCITY, _GYRO_BIAS] = by_turning = rotation @ skew(self.point)
        found[_POSITION, _ROTATION] = -by_turning
        found[_VELOCITY, _ROTATION] = -rotation @ skew(cross(self.rate - first.gyro_bias[0], self.point))
        if self.fall is not None:
            about = self.linearisation_point
            bias = first.bias_or_acceleration[0] - about.bias_or_acceleration[0]
            found[_FORCE_BIAS, _FORCE_BIAS] = turned = about.rotation[0].T @ rotation
            found[_FORCE_BIAS, _ROTATION] = -turned @ skew(about.rotation[0].T @ self.fall + bias)
        return found


def _velocity(states: InertialStates, point: FloatArray, rate: FloatArray) -> FloatArray:
    """(K, 3) velocity of a point in addition to that of the IMU's origin."""
    return matvec(states.rotation, cross(rate - states.gyro_bias, point))
