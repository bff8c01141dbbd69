"""Search for the trajectory of a robot with an IMU from measurements and samples alone: how a fixed-lag smoother starts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.inertial.initialisation import MIN_MEASUREMENTS, search_heading
from tsgt.geometry.inertial.solver import (
    InertialSetup,
    InertialSolution,
    inertial_knot_times,
    solve_inertial,
)
from tsgt.geometry.trajectory.gauss_newton import OUTLIER_THRESHOLD, robust_loss

if TYPE_CHECKING:
    from tsgt.geometry.inertial.live.held_samples import HeldSamples
    from tsgt.geometry.inertial.states import Gravity
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.model import ImuNoise, MotionPrior

GROWTH = 1.15  # Of the measurements from one search to the next: a search takes as long as twenty updates
MIN_STEP_S = 0.5
MIN_PATH_M = 0.3  # Of a single prism: without motion it does not tell the heading
MAX_COST = 3.0
"""Of a start, per degree of freedom, without its outliers; 1 is expected. The first measurements of a station that has moved
agree with the others within a few sigmas each, but not together as right ones do.
"""
DIFFUSE_SIGMAS = np.repeat([1.0, 1.0, 10.0], 3)
"""Sigmas of position, rotation and velocity of the first state's error, once measurements determine it: as without an IMU."""


class StartSearch:
    """Finds a trajectory without any prior knowledge, and not at every new measurement.

    ``min_prisms``: how many prisms must have been measured twice.
    """

    def __init__(
        self, noise: ImuNoise, gyro_only: MotionPrior | None, gravity: Gravity, min_prisms: int
    ) -> None:
        self._noise, self._gyro_only, self._gravity = noise, gyro_only, gravity
        self._min_prisms = min_prisms
        self._next_s = -np.inf

    def restart(self) -> None:
        """Search again at the next measurement."""
        self._next_s = -np.inf

    def find(self, observations: Observations, samples: HeldSamples) -> tuple[InertialSolution, bool]:
        """Find the trajectory, and whether measurements and samples agree with it.

        ``observations``: their layout is in the axes of the IMU, from its origin. Raises GeometryError if they do not determine
        the trajectory, or if they are few more than at the last search.
        """
        if len(observations) < MIN_MEASUREMENTS:
            raise GeometryError("too few measurements")
        newest_s = float(observations.time_s[-1])
        if newest_s < self._next_s:
            raise GeometryError("too little measured since the last search")
        counts = np.bincount(observations.prism)
        if np.count_nonzero(counts > 1) < self._min_prisms:
            raise GeometryError(f"fewer than {self._min_prisms} prisms have been measured twice")
        if np.count_nonzero(counts) == 1 and _path_m(observations) < MIN_PATH_M:
            raise GeometryError("one prism alone tells the heading of a robot only in motion")
        length_s = newest_s - float(observations.time_s[0])
        self._next_s = newest_s + max(MIN_STEP_S, (GROWTH - 1.0) * length_s)
        setup = InertialSetup(
            samples.contiguous(inertial_knot_times(observations.time_s)), self._noise, self._gyro_only
        )
        found = search_heading(observations, setup, self._gravity)
        if not found.determined:
            raise GeometryError("the measurements do not tell the heading of the robot")
        start = found.solution
        consistent = _is_consistent(start)
        if samples.odometry is not None:
            setup = replace(setup, odometry=samples.odometry)
            return solve_inertial(observations, setup, start.knots.with_wheels(), start.gravity), consistent
        return solve_inertial(
            observations, setup, start.knots, start.gravity, factors=start.factors
        ), consistent


def _is_consistent(start: InertialSolution) -> bool:
    """Whether measurements, samples and priors agree in a start, whose position, velocity and rotation are free."""
    outliers = start.squared_distances >= OUTLIER_THRESHOLD**2
    _, loss = robust_loss(start.squared_distances[outliers])
    freedom = 3 * np.count_nonzero(~outliers) - len(DIFFUSE_SIGMAS)
    return start.cost - float(loss.sum()) < MAX_COST * float(freedom)


def _path_m(observations: Observations) -> float:
    """Largest distance of the measured points from the first."""
    points = observations.in_world()
    return float(np.linalg.norm(points - points[0], axis=1).max())
