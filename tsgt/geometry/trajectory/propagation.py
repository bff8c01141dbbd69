"""One state, known with its uncertainty, at later instants. Pure.

What :class:`~tsgt.geometry.trajectory.query.Trajectory` predicts beyond its last knot, for one instant at a time: live, poses are due
one by one, twenty times a second and more, and numpy's calls for arrays of one element cost ten times what they compute.
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

_SMALL_RAD = 1e-2
_SMALL_STEP = 1e-2
"""In correlation times: below, a power series has the digits that the closed form loses."""

_SERIES_BELOW = 2.0
"""In correlation times: here the process noise's power series is exact to 14 digits with so many terms."""
_TERMS = 32
_POWERS = np.arange(_TERMS, dtype=np.float64)

_IDENTITY, _EYE = np.eye(3), np.eye(STATE_DIM)

_Vector = tuple[float, float, float]


class Propagator:
    """Predicts a robot from one state.

    Parameters
    ----------
    start
        One state.
    covariance
        (18, 18) of its error.
    prior
        How the robot moves from there.
    livelier
        Factor on the variance of its accelerations.
    """

    def __init__(
        self, start: States, covariance: FloatArray, prior: MotionPrior, *, process_noise_scale: float = 1.0
    ) -> None:
        self.time_s = float(start.time_s[0])
        self._start = start
        self._covariance = covariance
        self._times_s = np.array([prior.acceleration_correlation_time_s, prior.angular_acceleration_correlation_time_s])
        self._variances = process_noise_scale * axis_sigmas(prior) ** 2

    def at(self, time_s: float, *, dim: int = STATE_DIM) -> tuple[States, FloatArray]:
        """Return the state at an instant not before its own, and the covariance of the first parts of its error.

        Shapes are those that :meth:`~tsgt.geometry.trajectory.query.Trajectory.at` gives for one instant.
        """
        start, dt_s = self._start, time_s - self.time_s
        slow, turning = (acceleration_response(dt_s, float(each)) for each in self._times_s)
        wander_s2 = dt_s * dt_s / 12
        before: _Vector = tuple(start.angular_velocity[0].tolist())
        gained: _Vector = tuple(start.angular_acceleration[0].tolist())
        here = _sum(before, gained, turning[1])
        turn = _sum(_sum(_scaled(before, dt_s), gained, turning[0]), _cross(before, here), wander_s2)
        turned, by_turn = _turned_and_derivative(turn)
        states = States(
            np.array([time_s]),
            start.position + start.velocity * dt_s + start.acceleration * slow[0],
            start.rotation @ turned,
            start.velocity + start.acceleration * slow[1],
            np.array([here]),
            start.acceleration * slow[2],
            start.angular_acceleration * turning[2],
        )
        by_start, by_noise = _EYE.copy(), _EYE.copy()
        for rows, columns, places, turns in (
            (0, 6, dt_s, 0.0),
            (0, 12, slow[0], 0.0),
            (6, 12, slow[1], turning[1]),
            (12, 12, slow[2], turning[2]),
        ):
            _set_diagonal(by_start, rows, columns, places, turns)
        wandering = by_turn @ _skew(_scaled(before, wander_s2))
        by_start[3:6, 3:6] = turned.T
        by_start[3:6, 9:12] = by_turn * dt_s + wandering - by_turn @ _skew(_scaled(here, wander_s2))
        by_start[3:6, 15:18] = by_turn * turning[0] + wandering * turning[1]
        by_noise[3:6, 3:6] = by_turn
        by_noise[3:6, 9:12] = wandering
        by_start, by_noise = by_start[:dim], by_noise[:dim]
        noise = np.zeros((STATE_DIM, STATE_DIM))
        # Both kinds of axes, each for its three.
        by_axis = np.repeat(_noise(dt_s, self._times_s), 3, axis=0) * self._variances[:, None, None]
        np.einsum("iaja->aij", noise.reshape(3, 6, 3, 6))[...] = by_axis
        covariance = by_start @ self._covariance @ by_start.T + by_noise @ noise @ by_noise.T
        return states, (0.5 * (covariance + covariance.T))[None]


def acceleration_response(dt_s: float, time_s: float) -> _Vector:
    """Return what an acceleration of 1 becomes: the last column of :func:`~tsgt.geometry.trajectory.motion_prior.transition`."""
    s = dt_s / time_s
    if s < _SMALL_STEP:
        second = 0.5 - s / 6 * (1 - s / 4 * (1 - s / 5 * (1 - s / 6)))
    else:
        second = (math.expm1(-s) + s) / s**2
    first = -math.expm1(-s) / s if s > 0 else 1.0
    return dt_s**2 * second, dt_s * first, math.exp(-s)


def _series() -> FloatArray:
    """(32, 9) what each power of minus the step in correlation times gives to the process noise, which is 2 s of the sum.

    What a kick does after u is the exponential's series from its second, first or zeroth term on; products of two of them
    are integrated term by term.
    """
    found = np.zeros((_TERMS, 3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(_TERMS):
                terms = (
                    1 / (math.factorial(m + 2 - i) * math.factorial(k - m + 2 - j)) for m in range(k + 1)
                )
                found[k, i, j] = sum(terms) / (k + 5 - i - j)
    return found.reshape(_TERMS, 9)


_SERIES = _series()


def _noise(dt_s: float, times_s: FloatArray) -> FloatArray:
    """As :func:`~tsgt.geometry.trajectory.motion_prior.process_noise`, for one step and some correlation times; (N, 3, 3)."""
    s = dt_s / times_s
    if s.max() >= _SERIES_BELOW:
        return process_noise(dt_s, times_s)
    scale = np.array([dt_s * dt_s, dt_s, 1.0])
    sums = ((-s)[:, None] ** _POWERS @ _SERIES).reshape(-1, 3, 3)
    noise: FloatArray = (2.0 * s)[:, None, None] * sums * (scale[:, None] * scale)
    return noise


def _turned_and_derivative(turn: _Vector) -> tuple[FloatArray, FloatArray]:
    """Rotation matrix of a turn in rad and its right Jacobian, (3, 3) each; see :mod:`tsgt.geometry.rigid`."""
    square = turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2
    angle = math.sqrt(square)
    if angle > _SMALL_RAD:
        first, third = math.sin(angle) / angle, (angle - math.sin(angle)) / angle**3
        second = 0.5 * (math.sin(angle / 2) / (angle / 2)) ** 2
    else:
        first = 1 - square / 6 + square**2 / 120
        second = 0.5 - square / 24 + square**2 / 720
        third = 1 / 6 - square / 120 + square**2 / 5040
    across = _skew(turn)
    twice = across @ across
    return _IDENTITY + first * across + second * twice, _IDENTITY - second * across + third * twice


def _skew(v: _Vector) -> FloatArray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _cross(a: _Vector, b: _Vector) -> _Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _scaled(v: _Vector, factor: float) -> _Vector:
    return v[0] * factor, v[1] * factor, v[2] * factor


def _sum(a: _Vector, b: _Vector, factor: float) -> _Vector:
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


def _set_diagonal(matrix: FloatArray, row: int, column: int, places: float, turns: float) -> None:
    """Set the diagonals of two neighbouring blocks: three of places, three of turns."""
    flat = matrix.reshape(-1)
    first = row * STATE_DIM + column
    flat[first : first + 3 * (STATE_DIM + 1) : STATE_DIM + 1] = places
    first += 3 * (STATE_DIM + 1)
    flat[first : first + 3 * (STATE_DIM + 1) : STATE_DIM + 1] = turns
