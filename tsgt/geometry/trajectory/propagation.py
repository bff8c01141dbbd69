"""Propagation of one state and its covariance. Sans-I/O.

The same prediction as :class:`~tsgt.geometry.trajectory.query.Trajectory` beyond its last knot, for one time per call: live
poses are due one by one, twenty times a second, and numpy calls on arrays of one element cost ten times their arithmetic.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory.motion_prior import axis_sigmas, process_noise
from tsgt.geometry.trajectory.states import STATE_DIM, States

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import MotionPrior

_SMALL_ANGLE_RAD = 1e-2
_SMALL_STEP = 1e-2  # In correlation times: below, a power series keeps the digits that the closed form loses
_SERIES_BELOW = 2.0  # Correlation times; below, the series of _TERMS terms is exact to 14 digits
_TERMS = 32
_POWERS = np.arange(_TERMS, dtype=np.float64)

_IDENTITY, _EYE = np.eye(3), np.eye(STATE_DIM)

_Vector = tuple[float, float, float]


class Propagator:
    """Predicts a robot's motion from one state with the (18, 18) covariance of its error.

    ``process_noise_scale`` is a factor on the variance of the prior's accelerations.
    """

    def __init__(
        self, start: States, covariance: FloatArray, prior: MotionPrior, *, process_noise_scale: float = 1.0
    ) -> None:
        self.time_s = float(start.time_s[0])
        self._start = start
        self._covariance = covariance
        self._times_s = np.array(
            [prior.acceleration_correlation_time_s, prior.angular_acceleration_correlation_time_s]
        )
        self._found: dict[float, tuple[States, FloatArray, FloatArray]] = {}
        self._variances = process_noise_scale * axis_sigmas(prior) ** 2

    def at(self, time_s: float, *, dim: int = STATE_DIM) -> tuple[States, FloatArray]:
        """State at a time not before the start, and the (1, dim, dim) covariance of its leading error components."""
        states, by_start, by_noise = self._propagated(time_s)
        by_start, by_noise = by_start[:dim], by_noise[:dim]
        noise = np.zeros((STATE_DIM, STATE_DIM))
        # Linear and angular noise, each for three axes.
        by_axis = (
            np.repeat(_process_noise(time_s - self.time_s, self._times_s), 3, axis=0)
            * self._variances[:, None, None]
        )
        np.einsum("iaja->aij", noise.reshape(3, 6, 3, 6))[...] = by_axis
        covariance = by_start @ self._covariance @ by_start.T + by_noise @ noise @ by_noise.T
        return states, (0.5 * (covariance + covariance.T))[None]

    def by_start(self, time_s: float) -> FloatArray:
        """(18, 18) Jacobian of the error at a time not before the start by the error at the start."""
        return self._propagated(time_s)[1]

    def _propagated(self, time_s: float) -> tuple[States, FloatArray, FloatArray]:
        """State at a time, and the Jacobians of its error by that at the start and by the process noise.

        Kept, for poses and their common covariance are asked for one after the other.
        """
        if time_s not in self._found:
            self._found[time_s] = self._propagate(time_s)
        return self._found[time_s]

    def _propagate(self, time_s: float) -> tuple[States, FloatArray, FloatArray]:
        start, dt_s = self._start, time_s - self.time_s
        linear, angular = (acceleration_response(dt_s, float(each)) for each in self._times_s)
        magnus_s2 = dt_s * dt_s / 12
        rate: _Vector = tuple(start.angular_velocity[0].tolist())
        angular_acceleration: _Vector = tuple(start.angular_acceleration[0].tolist())
        rate_here = _sum(rate, angular_acceleration, angular[1])
        rotvec = _sum(
            _sum(_scaled(rate, dt_s), angular_acceleration, angular[0]), _cross(rate, rate_here), magnus_s2
        )
        delta_R, J_r = _exp_and_right_jacobian(rotvec)
        states = States(
            np.array([time_s]),
            start.position + start.velocity * dt_s + start.acceleration * linear[0],
            start.rotation @ delta_R,
            start.velocity + start.acceleration * linear[1],
            np.array([rate_here]),
            start.acceleration * linear[2],
            start.angular_acceleration * angular[2],
        )
        by_start, by_noise = _EYE.copy(), _EYE.copy()
        for rows, columns, linear_value, angular_value in (
            (0, 6, dt_s, 0.0),
            (0, 12, linear[0], 0.0),
            (6, 12, linear[1], angular[1]),
            (12, 12, linear[2], angular[2]),
        ):
            _set_diagonal(by_start, rows, columns, linear_value, angular_value)
        magnus_by_rate = J_r @ _skew(_scaled(rate, magnus_s2))
        by_start[3:6, 3:6] = delta_R.T
        by_start[3:6, 9:12] = J_r * dt_s + magnus_by_rate - J_r @ _skew(_scaled(rate_here, magnus_s2))
        by_start[3:6, 15:18] = J_r * angular[0] + magnus_by_rate * angular[1]
        by_noise[3:6, 3:6] = J_r
        by_noise[3:6, 9:12] = magnus_by_rate
        return states, by_start, by_noise


def acceleration_response(dt_s: float, time_s: float) -> _Vector:
    """Response to a unit acceleration: the last column of :func:`~tsgt.geometry.trajectory.motion_prior.transition`."""
    s = dt_s / time_s
    if s < _SMALL_STEP:
        second = 0.5 - s / 6 * (1 - s / 4 * (1 - s / 5 * (1 - s / 6)))
    else:
        second = (math.expm1(-s) + s) / s**2
    first = -math.expm1(-s) / s if s > 0 else 1.0
    return dt_s**2 * second, dt_s * first, math.exp(-s)


def _series() -> FloatArray:
    """(32, 9) power series of the process noise in minus the step in correlation times, without the factor 2 s."""
    coefficients = np.zeros((_TERMS, 3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(_TERMS):
                terms = (
                    1 / (math.factorial(m + 2 - i) * math.factorial(k - m + 2 - j)) for m in range(k + 1)
                )
                coefficients[k, i, j] = sum(terms) / (k + 5 - i - j)
    return coefficients.reshape(_TERMS, 9)


_SERIES = _series()


def _process_noise(dt_s: float, times_s: FloatArray) -> FloatArray:
    """(N, 3, 3) as :func:`~tsgt.geometry.trajectory.motion_prior.process_noise`, for one step and N correlation times."""
    s = dt_s / times_s
    if s.max() >= _SERIES_BELOW:
        return process_noise(dt_s, times_s)
    scale = np.array([dt_s * dt_s, dt_s, 1.0])
    sums = ((-s)[:, None] ** _POWERS @ _SERIES).reshape(-1, 3, 3)
    noise: FloatArray = (2.0 * s)[:, None, None] * sums * (scale[:, None] * scale)
    return noise


def _exp_and_right_jacobian(w: _Vector) -> tuple[FloatArray, FloatArray]:
    """(3, 3) rotation matrix and right Jacobian of a rotation vector in rad; see :mod:`tsgt.geometry.rigid`."""
    square = w[0] ** 2 + w[1] ** 2 + w[2] ** 2
    angle = math.sqrt(square)
    if angle > _SMALL_ANGLE_RAD:
        first, third = math.sin(angle) / angle, (angle - math.sin(angle)) / angle**3
        second = 0.5 * (math.sin(angle / 2) / (angle / 2)) ** 2
    else:
        first = 1 - square / 6 + square**2 / 120
        second = 0.5 - square / 24 + square**2 / 720
        third = 1 / 6 - square / 120 + square**2 / 5040
    skew_w = _skew(w)
    skew_w_squared = skew_w @ skew_w
    return (
        _IDENTITY + first * skew_w + second * skew_w_squared,
        _IDENTITY - second * skew_w + third * skew_w_squared,
    )


def _skew(v: _Vector) -> FloatArray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _cross(a: _Vector, b: _Vector) -> _Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _scaled(v: _Vector, factor: float) -> _Vector:
    return v[0] * factor, v[1] * factor, v[2] * factor


def _sum(a: _Vector, b: _Vector, factor: float) -> _Vector:
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


def _set_diagonal(matrix: FloatArray, row: int, column: int, linear: float, angular: float) -> None:
    """Set the diagonals of a 3x3 block and of its lower right neighbour, for the linear and the angular axes."""
    flat = matrix.reshape(-1)
    first = row * STATE_DIM + column
    flat[first : first + 3 * (STATE_DIM + 1) : STATE_DIM + 1] = linear
    first += 3 * (STATE_DIM + 1)
    flat[first : first + 3 * (STATE_DIM + 1) : STATE_DIM + 1] = angular
