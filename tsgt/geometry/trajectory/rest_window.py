"""Rest in the window of the fixed-lag smoother: smoothed states of a robot that stands still. Sans-I/O.

A robot at rest may drive off at any moment. So predictions, gates and the anchor prior keep the motion prior, and rest is
evidence for smoothed states alone: from the tracked solution, a Gauss-Newton step with the process factors of rest. What a
stop says about the pose is limited to the window in return. See docs/explanation/continuous-trajectory.md, "Rest".
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rest import add_vibration, find_rest, rest_factors, steps_in_rest, with_vibration
from tsgt.geometry.trajectory.block_tridiagonal import factorise
from tsgt.geometry.trajectory.gauss_newton import AnchorPrior, assemble, nearest_knots
from tsgt.geometry.trajectory.measurement_factors import Observations, merge_observations
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.geometry.trajectory.query import Trajectory
from tsgt.geometry.trajectory.sensitivity import WindowSensitivity, common_covariance
from tsgt.geometry.trajectory.states import ProcessFactors, States

if TYPE_CHECKING:
    from tsgt.geometry.rest import RestInterval
    from tsgt.model import MotionPrior

HISTORY_S = 12.0
"""Raw measurements that are searched for rest: a stop that began before the window is recognised by what came before, and a
slow sway in windows of nine seconds."""

MAX_SPEED_MPS, MAX_RATE_RADPS = 0.1, 0.1
"""Of a robot that may stand still, far above the errors of estimated velocities: while it drives, nothing is searched."""


class RestWindow:
    """Finds rest in the newest measurements, and solves the window again with it."""

    def __init__(self, prior: MotionPrior) -> None:
        self._prior = prior
        self._newest: Observations | None = None
        self._rest: list[RestInterval] | None = None  # In the newest measurements; None: not searched yet

    def add(self, new: Observations) -> None:
        """Take measurements, in the order of time."""
        newest = merge_observations(self._newest, new)
        self._newest = newest.select(newest.time_s >= newest.time_s[-1] - HISTORY_S)
        self._rest = None

    def solve(
        self,
        observations: Observations,
        knots: States,
        anchor: AnchorPrior,
        common: WindowSensitivity | None,
    ) -> Trajectory | None:
        """Return the trajectory of a window that was solved with the motion prior alone; None: the robot moves all the time.

        Raises GeometryError: it is not determined, by rounding alone.
        """
        if self._newest is None or not _may_rest(knots).any():
            return None
        if self._rest is None:
            self._rest = find_rest(self._newest)
        rest = self._rest
        if not steps_in_rest(rest, knots.time_s).any():
            return None
        moving = np.repeat(axis_sigmas(self._prior)[None], len(knots) - 1, axis=0)
        sigmas, information = rest_factors(rest, knots.time_s, moving, observations.layout)
        process = ProcessFactors.of(knots.time_s, self._prior, sigmas, information)
        observations = with_vibration(observations, rest, observations.sigmas_m)
        knot_index = nearest_knots(knots.time_s, observations.time_s)
        rejectable = np.ones(len(observations), np.bool_)
        # One step: it is millimetres long.
        system = assemble(observations, knot_index, knots, process, anchor, rejectable=rejectable)
        factor = factorise(system.diagonal, system.off_diagonal)
        knots = knots.retract(factor.solve(-system.gradient))
        covariance, cross_covariance = factor.marginals()
        add_vibration(rest, knots.time_s, observations.layout, covariance, cross_covariance)
        displacement = None
        if common is not None:
            displacement = common.displacement(
                observations, system.linearised, system.weights, knot_index, anchor, factor
            )
        return Trajectory(
            knots,
            self._prior,
            covariance,
            cross_covariance,
            sigmas=sigmas,
            common=None if displacement is None else common_covariance(displacement),
        )


def _may_rest(knots: States) -> np.ndarray:
    """(K - 1,) whether the robot is slow at both ends of a step."""
    slow = np.linalg.norm(knots.velocity, axis=1) < MAX_SPEED_MPS
    slow &= np.linalg.norm(knots.angular_velocity, axis=1) < MAX_RATE_RADPS
    return np.asarray(slow[1:] & slow[:-1])
