"""Propagation of one state and its covariance. Sans-I/O.

The same prediction as :class:`~tsgt.geometry.trajectory.query.Trajectory` beyond its last knot, for a few times per call: live
poses are due twenty times a second, and numpy calls on arrays of a few elements cost ten times their arithmetic.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import IDENTITY, skew
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

_MAX_FOUND = 16  # An epoch asks for a few sets of times, each more than once

_SCALE_POWERS = np.array([2.0, 1.0, 0.0])
_EYE = np.eye(STATE_DIM)

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
        self._found: dict[tuple[float, ...], tuple[States, FloatArray, FloatArray]] = {}
        self._variances = process_noise_scale * axis_sigmas(prior) ** 2

    def at(self, time_s: float, *, dim: int = STATE_DIM) -> tuple[States, FloatArray]:
        """State at a time not before the start, and the (1, dim, dim) covariance of its leading error components."""
        return self.at_times(np.array([time_s]), dim=dim)

    def by_start(self, time_s: float) -> FloatArray:
        """(18, 18) Jacobian of the error at a time not before the start by the error at the start."""
        jacobian: FloatArray = self.by_start_at_times(np.array([time_s]))[0]
        return jacobian

    def at_times(self, time_s: FloatArray, *, dim: int = STATE_DIM) -> tuple[States, FloatArray]:
        """States at N times, none before the start, and the (N, dim, dim) covariance of their leading error components.

        The same bits for a time alone as with others.
        """
        states, by_start, by_noise = self._propagated(time_s)
        by_start, by_noise = by_start[:, :dim], by_noise[:, :dim]
        noise = np.zeros((len(time_s), STATE_DIM, STATE_DIM))
        # Linear and angular noise, each for three axes.
        by_axis = np.repeat(_process_noise(time_s - self.time_s, self._times_s), 3, axis=1)
        by_axis *= self._variances[:, None, None]
        np.einsum("niaja->naij", noise.reshape(-1, 3, 6, 3, 6))[...] = by_axis
        covariance = by_start @ self._covariance @ by_start.swapaxes(1, 2)
        covariance += by_noise @ noise @ by_noise.swapaxes(1, 2)
        return states, 0.5 * (covariance + covariance.swapaxes(1, 2))

    def by_start_at_times(self, time_s: FloatArray) -> FloatArray:
        """(N, 18, 18) Jacobian of the errors at N times, none before the start, by the error at the start."""
        return self._propagated(time_s)[1]

    def _propagated(self, time_s: FloatArray) -> tuple[States, FloatArray, FloatArray]:
        """States at N times, and the Jacobians of their errors by that at the start and by the process noise.

        Kept, for poses and their common covariance are asked for one after the other.
        """
        key = tuple(time_s.tolist())
        if key not in self._found:
            if len(self._found) >= _MAX_FOUND:  # without measurements, one start serves for hours
                self._found.clear()
            self._found[key] = self._propagate(time_s)
        return self._found[key]

    def _propagate(self, time_s: FloatArray) -> tuple[States, FloatArray, FloatArray]:
        start, count = self._start, len(time_s)
        rate: _Vector = tuple(start.angular_velocity[0].tolist())
        angular_acceleration: _Vector = tuple(start.angular_acceleration[0].tolist())
        steps, rates_here, rotvecs = [], [], []
        for each_s in time_s.tolist():
            dt_s = each_s - self.time_s
            linear, angular = (acceleration_response(dt_s, each) for each in self._times_s.tolist())
            magnus_s2 = dt_s * dt_s / 12
            rate_here = _sum(rate, angular_acceleration, angular[1])
            rotvec = _sum(
                _sum(_scaled(rate, dt_s), angular_acceleration, angular[0]),
                _cross(rate, rate_here),
                magnus_s2,
            )
            steps.append((dt_s, magnus_s2, *linear, *angular))
            rates_here.append(rate_here)
            rotvecs.append(rotvec)
        columns = np.array(steps)
        dt, magnus, linear_0, linear_1, linear_2, angular_0, angular_1, angular_2 = columns.T[:, :, None]
        delta_R, J_r = _exp_and_right_jacobian(rotvecs)
        states = States(
            time_s,
            start.position + start.velocity * dt + start.acceleration * linear_0,
            start.rotation @ delta_R,
            start.velocity + start.acceleration * linear_1,
            np.array(rates_here),
            start.acceleration * linear_2,
            start.angular_acceleration * angular_2,
        )
        by_start, by_noise = np.empty((2, count, STATE_DIM, STATE_DIM))
        by_start[:] = by_noise[:] = _EYE
        _set_diagonal(by_start, 0, 6, dt, 0.0)
        _set_diagonal(by_start, 0, 12, linear_0, 0.0)
        _set_diagonal(by_start, 6, 12, linear_1, angular_1)
        _set_diagonal(by_start, 12, 12, linear_2, angular_2)
        by_rate, by_rate_here = (J_r @ skew(magnus * np.array(each)) for each in (rate, rates_here))
        by_start[:, 3:6, 3:6] = delta_R.swapaxes(1, 2)
        by_start[:, 3:6, 9:12] = J_r * dt[:, :, None] + by_rate - by_rate_here
        by_start[:, 3:6, 15:18] = J_r * angular_0[:, :, None] + by_rate * angular_1[:, :, None]
        by_noise[:, 3:6, 3:6] = J_r
        by_noise[:, 3:6, 9:12] = by_rate
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


def _process_noise(dt_s: FloatArray, times_s: FloatArray) -> FloatArray:
    """(N, T, 3, 3) as :func:`~tsgt.geometry.trajectory.motion_prior.process_noise`, for N steps and T correlation times."""
    s = dt_s[:, None] / times_s
    sums = ((-s)[:, :, None] ** _POWERS @ _SERIES).reshape(*s.shape, 3, 3)
    scale = dt_s[:, None] ** _SCALE_POWERS
    noise: FloatArray = (2.0 * s)[:, :, None, None] * sums * (scale[:, :, None] * scale[:, None, :])[:, None]
    far = s.max(axis=1) >= _SERIES_BELOW
    if far.any():
        noise[far] = process_noise(dt_s[far, None], times_s)
    return noise


def _exp_and_right_jacobian(rotvecs: list[_Vector]) -> tuple[FloatArray, FloatArray]:
    """(N, 3, 3) rotation matrices and right Jacobians of rotation vectors in rad; see :mod:`tsgt.geometry.rigid`."""
    coefficients = []
    for w in rotvecs:
        square = w[0] ** 2 + w[1] ** 2 + w[2] ** 2
        angle = math.sqrt(square)
        if angle > _SMALL_ANGLE_RAD:
            first, third = math.sin(angle) / angle, (angle - math.sin(angle)) / angle**3
            second = 0.5 * (math.sin(angle / 2) / (angle / 2)) ** 2
        else:
            first = 1 - square / 6 + square**2 / 120
            second = 0.5 - square / 24 + square**2 / 720
            third = 1 / 6 - square / 120 + square**2 / 5040
        coefficients.append((first, second, third))
    first_, second_, third_ = np.array(coefficients).T[:, :, None, None]
    skew_w = skew(np.array(rotvecs))
    skew_w_squared = skew_w @ skew_w
    return (
        IDENTITY + first_ * skew_w + second_ * skew_w_squared,
        IDENTITY - second_ * skew_w + third_ * skew_w_squared,
    )


def _cross(a: _Vector, b: _Vector) -> _Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _scaled(v: _Vector, factor: float) -> _Vector:
    return v[0] * factor, v[1] * factor, v[2] * factor


def _sum(a: _Vector, b: _Vector, factor: float) -> _Vector:
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


def _set_diagonal(
    matrices: FloatArray, row: int, column: int, linear: FloatArray, angular: FloatArray | float
) -> None:
    """Set the diagonals of 3x3 blocks and of their lower right neighbours, for the linear and the angular axes."""
    flat = matrices.reshape(len(matrices), -1)
    first = row * STATE_DIM + column
    flat[:, first : first + 3 * (STATE_DIM + 1) : STATE_DIM + 1] = linear
    first += 3 * (STATE_DIM + 1)
    flat[:, first : first + 3 * (STATE_DIM + 1) : STATE_DIM + 1] = angular
