"""The motion prior: a Gaussian process on the acceleration of each axis. Sans-I/O.

The acceleration of each of the six axes (position in frame ``station1``, rotation in the robot frame) is an
Ornstein-Uhlenbeck process with a standard deviation and a correlation time (R. A. Singer, "Estimating optimal tracking
filter performance for manned maneuvering targets", IEEE T-AES 6(4), 1970). Its limits are white noise on acceleration (short
correlation time) and on jerk (long). The state of an axis (position, velocity, acceleration) propagates linearly:
``x(t + dt) = Phi(dt) x(t) + w``, ``w ~ N(0, Q(dt))``. docs/explanation/continuous-trajectory.md derives Phi and Q.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import TINY
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike

    from tsgt.geometry.rigid import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
_DT_POWERS = np.array([2.0, 1.0, 0.0])  # Powers of dt that scale position, velocity and acceleration
_WEIGHTED_NODES = np.sqrt(_WEIGHTS)[:, None] * _NODES[:, None] ** _DT_POWERS

_SERIES_BELOW = 1e-2
_QUADRATURE_BELOW = 2.0  # In correlation times: above this the closed form of Q loses no significant digits


def axis_correlation_times_s(prior: MotionPrior) -> FloatArray:
    """(6,) correlation time of each axis in s."""
    return np.repeat(
        [prior.acceleration_correlation_time_s, prior.angular_acceleration_correlation_time_s], 3
    )


def axis_sigmas(prior: MotionPrior) -> FloatArray:
    """(6,) one sigma of the acceleration of each axis in m/s^2 and rad/s^2."""
    return np.array([*prior.acceleration_sigma_mps2, *prior.angular_acceleration_sigma_radps2])


def prior_from_axes(sigmas: Iterable[float], times_s: Iterable[float]) -> MotionPrior:
    """Make a prior from one sigma per axis, (6,), and the two correlation times in s."""
    x, y, z, roll, pitch, yaw = map(float, sigmas)
    time_s, angular_time_s = map(float, times_s)
    return MotionPrior(
        acceleration_sigma_mps2=(x, y, z),
        acceleration_correlation_time_s=time_s,
        angular_acceleration_sigma_radps2=(roll, pitch, yaw),
        angular_acceleration_correlation_time_s=angular_time_s,
    )


def transition(dt_s: ArrayLike, time_s: ArrayLike) -> FloatArray:
    """Transition matrices ``Phi(dt)``, (..., 3, 3), of one axis' (position, velocity, acceleration); dt >= 0, times in s."""
    dt_s = np.asarray(dt_s, np.float64)
    s = dt_s / np.asarray(time_s, np.float64)
    phi = np.zeros((*s.shape, 3, 3))
    phi[..., 0, 0] = phi[..., 1, 1] = 1.0
    phi[..., 0, 1] = dt_s
    phi[..., 2] = _impulse_response(s) * dt_s[..., None] ** _DT_POWERS
    return phi


def process_noise(dt_s: ArrayLike, time_s: ArrayLike) -> FloatArray:
    """Process noise ``Q(dt)`` of one axis with unit acceleration sigma, (..., 3, 3); arguments as :func:`transition`."""
    dt_s = np.asarray(dt_s, np.float64)
    return _scale_by_dt(_unit_step_noise(dt_s / np.asarray(time_s, np.float64)), dt_s)


def process_information(dt_s: ArrayLike, time_s: ArrayLike) -> FloatArray:
    """Inverse of :func:`process_noise`, (..., 3, 3), computed in units of dt, which must be above zero, for conditioning."""
    dt_s = np.asarray(dt_s, np.float64)
    information = np.linalg.inv(_unit_step_noise(dt_s / np.asarray(time_s, np.float64)))
    return _scale_by_dt(np.asarray(information, np.float64), 1.0 / dt_s)


def interpolation_weights(
    before_s: FloatArray, after_s: FloatArray, time_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Interpolation of one axis between two known states (Barfoot, section 3.4, for this prior).

    The query is ``before_s`` after the earlier and ``after_s`` before the later state, not negative, their sum above zero.
    Returns (..., 3, 3) each: the mean is ``from_earlier @ x_earlier + from_later @ x_later``, and ``conditional`` is
    the covariance given both states, for unit acceleration sigma.
    """
    dts_s = np.stack([before_s, before_s + after_s, after_s])
    phi, phi_step, phi_after = transition(dts_s, time_s)
    noise, step_noise = _unit_step_noise(dts_s[:2] / time_s)
    q = _scale_by_dt(noise, dts_s[0])
    step_information = _scale_by_dt(np.linalg.inv(step_noise), 1.0 / dts_s[1])
    gain = q @ phi_after.swapaxes(-1, -2) @ step_information
    from_earlier = phi - gain @ phi_step
    conditional = q - gain @ phi_after @ q
    return from_earlier, gain, 0.5 * (conditional + conditional.swapaxes(-1, -2))


def _impulse_response(s: FloatArray) -> FloatArray:
    """(exp(-s) - 1 + s) / s^2, (1 - exp(-s)) / s, exp(-s), (..., 3): position, velocity, acceleration; 1/2, 1, 1 at 0."""
    above_zero = np.maximum(s, TINY)
    decayed = -np.expm1(-above_zero)
    series = 0.5 - s / 6 * (1 - s / 4 * (1 - s / 5 * (1 - s / 6)))
    response = np.empty((*s.shape, 3))
    response[..., 0] = np.where(s >= _SERIES_BELOW, (s - decayed) / above_zero / above_zero, series)
    response[..., 1] = decayed / above_zero
    response[..., 2] = np.exp(-s)
    return response


def _unit_step_noise(s: FloatArray) -> FloatArray:
    """Q for dt = 1 and unit acceleration sigma, where s is dt in correlation times; (..., 3, 3)."""
    short = s < _QUADRATURE_BELOW
    if short.all():
        return _quadrature_noise(s)
    q = np.empty((*s.shape, 3, 3))
    q[short] = _quadrature_noise(s[short])
    q[~short] = _closed_form_noise(s[~short])
    return q


def _quadrature_noise(s: FloatArray) -> FloatArray:
    # Response to an impulse at the fraction 1 - node of the step.
    response = _impulse_response(s[..., None] * _NODES) * _WEIGHTED_NODES
    q: FloatArray = 2.0 * s[..., None, None] * (response.swapaxes(-1, -2) @ response)
    return q


def _closed_form_noise(s: FloatArray) -> FloatArray:
    one, two = np.exp(-s), np.exp(-2 * s)
    q = np.empty((*s.shape, 3, 3))
    q[..., 0, 0] = (1 - two + 2 * s + 2 * s**3 / 3 - 2 * s**2 - 4 * s * one) / s**4
    q[..., 0, 1] = q[..., 1, 0] = (two + 1 - 2 * one + 2 * s * one - 2 * s + s**2) / s**3
    q[..., 0, 2] = q[..., 2, 0] = (1 - two - 2 * s * one) / s**2
    q[..., 1, 1] = (4 * one - 3 - two + 2 * s) / s**2
    q[..., 1, 2] = q[..., 2, 1] = (two + 1 - 2 * one) / s
    q[..., 2, 2] = 1 - two
    return q


def _scale_by_dt(matrix: FloatArray, dt_s: FloatArray) -> FloatArray:
    scale = dt_s[..., None] ** _DT_POWERS
    scaled: FloatArray = scale[..., :, None] * matrix * scale[..., None, :]
    return scaled
