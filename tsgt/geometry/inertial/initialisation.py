"""Start of a trajectory with an IMU, from measurements of any number of prisms. Sans-I/O.

The gyro gives the rotation over some seconds but for its start; the mean specific force gives the vertical. What remains is the
heading: each of several is solved to the end, and that of the lowest cost is the start, if no other explains the measurements as
well. Measurements of one prism tell the heading only while the robot accelerates or turns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.inertial.preintegration import preintegrate
from tsgt.geometry.inertial.solver import InertialSetup, inertial_knot_times, solve_inertial
from tsgt.geometry.inertial.states import Gravity, InertialStates
from tsgt.geometry.rigid import FloatArray, exp_so3, log_so3, matvec
from tsgt.geometry.trajectory.gauss_newton import LOOSE_GAIN_TOLERANCE

if TYPE_CHECKING:
    from tsgt.geometry.inertial.factors import InertialFactors
    from tsgt.geometry.inertial.solver import InertialSolution
    from tsgt.geometry.trajectory.measurement_factors import Observations

HEADINGS = 8  # That are tried: none is more than 22.5 degrees off
SEARCH_ITERATIONS = 12
MIN_COST_DIFFERENCE = 30.0
"""Of the best heading from the next: twice the logarithm of the ratio of their likelihoods."""
MAX_HEADING_SIGMA_RAD = 0.1
SAME_SOLUTION_RAD = 0.05  # Headings that end closer than this are one solution
MIN_MEASUREMENTS = 8

_TRACK_TIME_S = 0.2  # Weight of a prism's track falls to a quarter this long from a measurement


class HeadingSearch(NamedTuple):
    """Result of a search over headings."""

    solution: InertialSolution  # of the lowest cost
    heading_sigma_rad: float
    cost_difference: float  # to the next best solution; infinite where all headings lead to one

    @property
    def determined(self) -> bool:
        """Whether no other heading explains the measurements."""
        return self.heading_sigma_rad < MAX_HEADING_SIGMA_RAD and self.cost_difference > MIN_COST_DIFFERENCE


def search_heading(observations: Observations, setup: InertialSetup, gravity: Gravity) -> HeadingSearch:
    """Solve a few seconds of measurements, in the order of time, from several headings.

    Raises GeometryError: too few measurements.
    """
    if len(observations) < MIN_MEASUREMENTS:
        raise GeometryError(
            f"a start needs {MIN_MEASUREMENTS} measurements, {len(observations)} have been measured"
        )
    time_s = inertial_knot_times(observations.time_s)
    zero = np.zeros(3)
    found = preintegrate(setup.samples, time_s[:-1], time_s[1:], zero, zero)
    turned, gained = np.empty((len(time_s), 3, 3)), zero
    turned[0] = np.eye(3)
    for step in range(len(found)):
        gained = gained + turned[step] @ found.velocity[step]
        turned[step + 1] = turned[step] @ found.rotation[step]
    level = _rotation_to_vertical(gained)
    factors: InertialFactors | None = None  # The same for all headings: they start with the same biases
    solutions = []
    for heading in np.arange(HEADINGS) * (2 * np.pi / HEADINGS):
        rotation = exp_so3(np.array([0.0, 0.0, heading])) @ level @ turned
        guess = states_on_tracks(observations, time_s, rotation, zero)
        if factors is None:
            factors = setup.factors(guess, found)
        try:
            solutions.append(
                solve_inertial(
                    observations,
                    setup,
                    guess,
                    gravity,
                    factors=factors,
                    max_iterations=SEARCH_ITERATIONS,
                    gain_tolerance=LOOSE_GAIN_TOLERANCE,
                    reject_outliers=False,
                )
            )
        except GeometryError:
            continue
    if not solutions:
        raise GeometryError("the measurements do not determine the trajectory from any heading")
    solutions.sort(key=lambda solution: solution.cost)
    best = solutions[0]
    differences = [
        other.cost - best.cost
        for other in solutions[1:]
        if _rotation_between(best, other) > SAME_SOLUTION_RAD
    ]
    covariance = best.factor.marginals()[0][-1, 3:6, 3:6]
    vertical = best.knots.rotation[-1, 2]
    return HeadingSearch(
        best, float(np.sqrt(vertical @ covariance @ vertical)), min(differences, default=np.inf)
    )


def states_on_tracks(
    observations: Observations, time_s: FloatArray, rotation: FloatArray, gyro_bias: FloatArray
) -> InertialStates:
    """States at times, (K,), with given rotations, (K, 3, 3): positions from the prisms' tracks, interpolated linearly."""
    points = observations.in_world()
    total, weights = np.zeros((len(time_s), 3)), np.zeros((len(time_s), 1))
    for prism in np.unique(observations.prism):
        rows = observations.prism == prism
        measured_s = observations.time_s[rows]
        track = np.stack([np.interp(time_s, measured_s, each) for each in points[rows].T], axis=1)
        after = np.clip(measured_s.searchsorted(time_s), 1, max(len(measured_s) - 1, 1))
        nearest_s = np.minimum(
            np.abs(time_s - measured_s[after - 1]),
            np.abs(time_s - measured_s[np.minimum(after, len(measured_s) - 1)]),
        )
        weight = (1.0 + nearest_s / _TRACK_TIME_S)[:, None] ** -2.0
        total += weight * (track - matvec(rotation, observations.layout[prism]))
        weights += weight
    position = total / weights
    velocity = np.gradient(position, time_s, axis=0) if len(time_s) > 1 else np.zeros_like(position)
    return InertialStates(
        time_s,
        position,
        rotation,
        velocity,
        np.broadcast_to(gyro_bias, position.shape).copy(),
        np.zeros_like(position),
        np.empty((len(time_s), 0)),
    )


def _rotation_to_vertical(upward: FloatArray) -> FloatArray:
    """Shortest rotation, (3, 3), that takes a vector, (3,), to the z axis."""
    direction = upward / np.linalg.norm(upward)
    axis = np.array([direction[1], -direction[0], 0.0])
    sine = float(np.linalg.norm(axis))
    if sine == 0.0:
        return np.eye(3) if direction[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return exp_so3(axis / sine * np.arctan2(sine, direction[2]))


def _rotation_between(one: InertialSolution, other: InertialSolution) -> float:
    """Rotation in rad between the ends of two solutions."""
    return float(np.linalg.norm(log_so3(one.knots.rotation[-1].T @ other.knots.rotation[-1])))
