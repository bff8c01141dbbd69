"""How a robot may move between two instants: its acceleration as a Gaussian process. Pure.

Each of the six axes (position in frame ``station1``, rotation in the frame of the robot) has an acceleration of a
certain size that lasts for a certain time, then another one (an Ornstein-Uhlenbeck process; R. A. Singer, "Estimating
optimal tracking filter performance for manned maneuvering targets", IEEE T-AES 6(4), 1970). Where it lasts for ever
short this is white noise on acceleration, where it lasts long it is white noise on jerk; the data tell which. All three
parts of an axis (position, velocity, acceleration) at a later instant are linear in those at an earlier one, plus noise:
``x(t + dt) = Phi(dt) x(t) + w``, ``w ~ N(0, Q(dt))``. docs/explanation/continuous-trajectory.md derives all of it.
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
_ORDERS = np.array([2.0, 1.0, 0.0])
"""Powers of time that position, velocity and acceleration grow with."""
_WEIGHED_NODES = np.sqrt(_WEIGHTS)[:, None] * _NODES[:, None] ** _ORDERS

_SERIES_BELOW = 1e-2
_QUADRATURE_BELOW = 2.0
"""In correlation times: from here the closed forms lose no digits that matter."""


def axis_correlation_times_s(prior: MotionPrior) -> FloatArray:
    """Correlation time of each axis in s, shape (6,)."""
    return np.repeat([prior.acceleration_correlation_time_s, prior.angular_acceleration_correlation_time_s], 3)


def axis_sigmas(prior: MotionPrior) -> FloatArray:
    """One sigma of the acceleration of each axis in m/s^2 and rad/s^2, shape (6,)."""
    return np.array([*prior.acceleration_sigma_mps2, *prior.angular_acceleration_sigma_radps2])


def prior_from_axes(sigmas: Iterable[float], times_s: Iterable[float]) -> MotionPrior:
    """Make a prior of one sigma per axis, shape (6,), and the two correlation times in s."""
    x, y, z, roll, pitch, yaw = map(float, sigmas)
    time_s, angular_time_s = map(float, times_s)
    return MotionPrior(
        acceleration_sigma_mps2=(x, y, z),
        acceleration_correlation_time_s=time_s,
        angular_acceleration_sigma_radps2=(roll, pitch, yaw),
        angular_acceleration_correlation_time_s=angular_time_s,
    )


def transition(dt_s: ArrayLike, time_s: ArrayLike) -> FloatArray:
    """Return ``Phi(dt)`` of one axis.

    Parameters
    ----------
    dt_s
        From the earlier to the later instant, in s, not negative.
    time_s
        Correlation time of the acceleration in s; broadcast with ``dt_s`` to shape (...).

    Returns
    -------
    FloatArray
        Shape (..., 3, 3), for (position, velocity, acceleration).
    """
    dt_s = np.asarray(dt_s, np.float64)
    s = dt_s / np.asarray(time_s, np.float64)
    phi = np.zeros((*s.shape, 3, 3))
    phi[..., 0, 0] = phi[..., 1, 1] = 1.0
    phi[..., 0, 1] = dt_s
    phi[..., 2] = _kicked(s) * dt_s[..., None] ** _ORDERS
    return phi


def process_noise(dt_s: ArrayLike, time_s: ArrayLike) -> FloatArray:
    """Return ``Q(dt)`` of one axis whose acceleration has a sigma of 1.

    Parameters
    ----------
    dt_s, time_s
        As for :func:`transition`.

    Returns
    -------
    FloatArray
        Shape (..., 3, 3), symmetric, for (position, velocity, acceleration).
    """
    dt_s = np.asarray(dt_s, np.float64)
    return _scaled(_noise_in_units_of_dt(dt_s / np.asarray(time_s, np.float64)), dt_s)


def process_information(dt_s: ArrayLike, time_s: ArrayLike) -> FloatArray:
    """Return the inverse of :func:`process_noise`, which is better conditioned in units of dt; shape (..., 3, 3).

    ``dt_s`` must be above zero.
    """
    dt_s = np.asarray(dt_s, np.float64)
    information = np.linalg.inv(_noise_in_units_of_dt(dt_s / np.asarray(time_s, np.float64)))
    return _scaled(np.asarray(information, np.float64), 1.0 / dt_s)


def interpolation_weights(
    before_s: FloatArray, after_s: FloatArray, time_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Interpolate one axis between two known instants.

    The mean is ``from_earlier @ x_earlier + from_later @ x_later``, the covariance that is added to what comes of
    theirs is ``left`` (for an acceleration sigma of 1).

    Parameters
    ----------
    before_s
        From the earlier instant to the one asked for, in s, not negative.
    after_s
        From there to the later one, in s, not negative; the sum of both is above zero.
    time_s
        Correlation time of the acceleration in s.

    Returns
    -------
    from_earlier, from_later, left : FloatArray
        Shape (..., 3, 3) each.
    """
    dts_s = np.stack([before_s, after_s, before_s + after_s])
    q = process_noise(before_s, time_s)
    phi, to_later, all_the_way = transition(dts_s, time_s)
    gain = q @ np.swapaxes(to_later, -1, -2) @ process_information(dts_s[2], time_s)
    from_earlier = phi - gain @ all_the_way
    left = q - gain @ to_later @ q
    return from_earlier, gain, 0.5 * (left + np.swapaxes(left, -1, -2))


def _kicked(s: FloatArray) -> FloatArray:
    """Position, velocity and acceleration a time s after a kick, in units of that time, (..., 3).

    They are (exp(-s) - 1 + s) / s^2, (1 - exp(-s)) / s and exp(-s); 1/2, 1 and 1 at 0.
    """
    above_zero = np.maximum(s, TINY)
    lost = -np.expm1(-above_zero)
    series = 0.5 - s / 6 * (1 - s / 4 * (1 - s / 5 * (1 - s / 6)))
    kicked = np.empty((*s.shape, 3))
    kicked[..., 0] = np.where(s >= _SERIES_BELOW, (s - lost) / above_zero / above_zero, series)
    kicked[..., 1] = lost / above_zero
    kicked[..., 2] = np.exp(-s)
    return kicked


def _noise_in_units_of_dt(s: FloatArray) -> FloatArray:
    """Return Q for dt = 1 and an acceleration sigma of 1, where s is 1 in correlation times; shape (..., 3, 3)."""
    short = s < _QUADRATURE_BELOW
    if short.all():
        return _by_quadrature(s)
    q = np.empty((*s.shape, 3, 3))
    q[short] = _by_quadrature(s[short])
    q[~short] = _closed(s[~short])
    return q


def _by_quadrature(s: FloatArray) -> FloatArray:
    # Effect of a kick at a fraction 1 - node of the way: on position, velocity, acceleration.
    effect = _kicked(s[..., None] * _NODES) * _WEIGHED_NODES
    q: FloatArray = 2.0 * s[..., None, None] * (np.swapaxes(effect, -1, -2) @ effect)
    return q


def _closed(s: FloatArray) -> FloatArray:
    one, two = np.exp(-s), np.exp(-2 * s)
    q = np.empty((*s.shape, 3, 3))
    q[..., 0, 0] = (1 - two + 2 * s + 2 * s**3 / 3 - 2 * s**2 - 4 * s * one) / s**4
    q[..., 0, 1] = q[..., 1, 0] = (two + 1 - 2 * one + 2 * s * one - 2 * s + s**2) / s**3
    q[..., 0, 2] = q[..., 2, 0] = (1 - two - 2 * s * one) / s**2
    q[..., 1, 1] = (4 * one - 3 - two + 2 * s) / s**2
    q[..., 1, 2] = q[..., 2, 1] = (two + 1 - 2 * one) / s
    q[..., 2, 2] = 1 - two
    return q


def _scaled(matrix: FloatArray, dt_s: FloatArray) -> FloatArray:
    scale = dt_s[..., None] ** _ORDERS
    scaled: FloatArray = scale[..., :, None] * matrix * scale[..., None, :]
    return scaled
