"""Rest: process factors of a robot that stands still, in the intervals in which it does. Sans-I/O.

At rest the velocity is zero within a small wander, and the acceleration far below that of driving. Before and after, the motion
prior applies: it carries the robot from and to zero velocity. The covariance follows: at rest all measurements determine the
same pose. See docs/explanation/continuous-trajectory.md, "Rest".
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations

WANDER_M = 2e-4
"""One sigma of the displacement per axis within a second, growing with the root of time: a robot sinks into snow."""

ACCELERATION_SIGMA_MPS2 = 0.01  # Far below any driving, and far above what rounding makes of zero


class RestInterval(NamedTuple):
    """An interval of rest, in s from the trajectory's time origin."""

    start_s: float
    end_s: float
    vibration_m: float  # One sigma per axis of the vibration of the prisms, as far as it is significant


def in_rest(intervals: Sequence[RestInterval], time_s: FloatArray) -> NDArray[np.intp]:
    """(N,) index of the interval that each time is in; -1: in none."""
    if not intervals:
        return np.full(len(time_s), -1)
    bounds = np.array([each[:2] for each in intervals])
    index = np.searchsorted(bounds[:, 0], time_s, side="right") - 1
    return np.where((index >= 0) & (time_s <= bounds[index, 1]), index, -1)


def rest_factors(
    intervals: Sequence[RestInterval], knots_s: FloatArray, sigmas: FloatArray, layout: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """Process factors of a robot at rest, for the steps between knots that lie in a rest interval.

    Parameters
    ----------
    sigmas : (K - 1, 6) acceleration sigmas of a moving robot.
    layout : (P, 3) prisms, relative to the reference point of the states, in m: rotations may displace them as translations do.

    Returns
    -------
    sigmas : (K - 1, 6) of all steps
    rest : (K - 1, 6) of :class:`~tsgt.geometry.trajectory.states.ProcessFactors`; None without rest
    """
    at_rest = steps_in_rest(intervals, knots_s)
    if not at_rest.any():
        return sigmas, None
    lever_m = _lever_m(layout)
    by_axis = np.repeat([1.0, 1.0 / lever_m], 3)
    half_step_s = 0.5 * np.diff(knots_s)[:, None]
    return (
        np.where(at_rest[:, None], ACCELERATION_SIGMA_MPS2 * by_axis, sigmas),
        np.where(at_rest[:, None], half_step_s / (WANDER_M * by_axis) ** 2, 0.0),
    )


def add_vibration(
    intervals: Sequence[RestInterval],
    knots_s: FloatArray,
    layout: FloatArray,
    covariance: FloatArray,
    cross_covariance: FloatArray,
) -> None:
    """Add the vibration at rest to the poses' covariances of a trajectory, (K, 18, 18), (K - 1, 18, 18), in place.

    The trajectory is that of the mean. A robot that rocks within what looks like vibration is off the mean by that much.
    """
    vibration_m2 = np.array([*(each.vibration_m**2 for each in intervals), 0.0])
    by_component = np.repeat([1.0, _lever_m(layout) ** -2.0], 3)
    at_knots = vibration_m2[in_rest(intervals, knots_s)]
    at_steps = np.where(steps_in_rest(intervals, knots_s), at_knots[1:], 0.0)
    components = np.arange(6)
    covariance[:, components, components] += at_knots[:, None] * by_component
    # The same error at both ends of a step, so that it is as large in between.
    cross_covariance[:, components, components] += at_steps[:, None] * by_component


def _lever_m(layout: FloatArray) -> float:
    """Root mean square distance of the prisms from the reference point."""
    return float(np.sqrt(np.mean(np.sum(layout**2, axis=1))))


def steps_in_rest(intervals: Sequence[RestInterval], knots_s: FloatArray) -> NDArray[np.bool_]:
    """(K - 1,) whether both knots of a step are in the same interval."""
    index = in_rest(intervals, knots_s)
    within: NDArray[np.bool_] = (index[1:] >= 0) & (index[1:] == index[:-1])
    return within


def with_vibration(
    observations: Observations, intervals: Sequence[RestInterval], stated_m: FloatArray
) -> Observations:
    """Raise the noise of measurements at rest to the ``stated_m``, (M, 3), and the vibration there, where it is below."""
    index = in_rest(intervals, observations.time_s)
    vibration_m = np.array([*(each.vibration_m for each in intervals), 0.0])[index]
    sigmas_m = np.maximum(observations.sigmas_m, np.hypot(stated_m, vibration_m[:, None]))
    return replace(observations, sigmas_m=np.where((index >= 0)[:, None], sigmas_m, observations.sigmas_m))
