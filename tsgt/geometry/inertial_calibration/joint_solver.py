"""States of an IMU and its set-up by Gauss-Newton. Sans-I/O."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.inertial import InertialAnchor, InertialStates
from tsgt.geometry.inertial.bordered import BorderedCholesky, factorise_bordered
from tsgt.geometry.inertial.solver import diffuse_inertial_prior
from tsgt.geometry.inertial.states import TILT_DIM
from tsgt.geometry.inertial_calibration.joint_system import (
    Border,
    JointEquations,
    JointPoint,
    JointProblem,
    assemble_border,
    assemble_states,
    knots_at_samples,
    stamp_times,
)
from tsgt.geometry.rigid import cross, exp_so3, matvec
from tsgt.geometry.trajectory import nearest_knots
from tsgt.geometry.trajectory.gauss_newton import (
    COST_TOLERANCE,
    MIN_STEP_FRACTION,
    PREDICTED_GAIN_TOLERANCE,
    REJECTION_THRESHOLD,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.inertial import ContiguousSamples, Gravity
    from tsgt.geometry.inertial_calibration.setup import ImuSetup, SetupPrior
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations, States
    from tsgt.model import ImuNoise

MAX_ITERATIONS = 25
MAX_KNOT_CHOICES = 5
MAX_ALL_ITERATIONS = (
    40  # Of all choices of knots while the latency moves on; a drive that tells it needs some 10
)
MAX_LATENCY_STEP_S = 0.002  # By which the latency may move until knots are chosen again


class JointSolution(NamedTuple):
    """States and set-up at the minimum of the cost."""

    point: JointPoint
    equations: JointEquations
    border: Border
    factor: BorderedCholesky
    problem: JointProblem
    iterations: int


def solve_jointly(
    observations: Observations,
    samples: ContiguousSamples,
    noise: ImuNoise,
    guess: Callable[[FloatArray, ImuSetup], InertialStates],
    prior: SetupPrior,
    gravity: Gravity,
    *,
    start: ImuSetup | None = None,
    on_iteration: Callable[[], None] = lambda: None,
) -> JointSolution:
    """Estimate states and set-up.

    ``guess``: gives states of the IMU at stamps for a set-up. ``start``: initial set-up, the prior's mean when not given.
    Raises GeometryError: the measurements determine neither.
    """
    setup = prior.mean if start is None else start
    solution, chosen_latency_s, iterations = None, setup.latency_s, 0
    for _ in range(MAX_KNOT_CHOICES):
        latency_s = setup.latency_s
        times_s, knot_index = knots_at_samples(stamp_times(observations, setup), samples)
        if solution is None:
            knots = guess(times_s, setup)
        else:
            knots = _moved(solution, times_s, latency_s - chosen_latency_s)
        chosen_latency_s = latency_s
        anchor = diffuse_inertial_prior(guess(times_s[:1], setup), gravity, noise)
        problem = JointProblem(
            observations, samples, noise, knot_index, without_tilt(anchor), prior, gravity.tilt_sigma_rad
        )
        solution = minimise(problem, JointPoint(knots, setup, gravity), on_iteration)
        setup, gravity = solution.point.setup, solution.point.gravity
        if abs(setup.latency_s - chosen_latency_s) < MAX_LATENCY_STEP_S:
            break
        iterations += solution.iterations
        if iterations >= MAX_ALL_ITERATIONS:
            solution = None
            break
    else:
        solution = None
    if solution is None:
        raise GeometryError(
            "the latency of the IMU does not converge: its samples do not belong to this drive"
        )
    if (solution.equations.states.squared_distances > REJECTION_THRESHOLD**2).any():
        rejectable = np.ones(len(observations), np.bool_)
        solution = minimise(replace(solution.problem, rejectable=rejectable), solution.point, on_iteration)
    return solution


def minimise(problem: JointProblem, point: JointPoint, on_iteration: Callable[[], None]) -> JointSolution:
    """Run Gauss-Newton with backtracking until the cost or the predicted gain falls below its tolerance."""
    sigmas = problem.prior_sigmas
    found = assemble_states(problem, point)
    iterations = 0
    while True:
        border = assemble_border(problem, point, found)
        corner = border.corner + np.diag(sigmas**-2.0)
        gradient = border.gradient + found.deviation / sigmas
        states = found.states
        factor = factorise_bordered(states.diagonal, states.off_diagonal, border.mixed, corner)
        step, shared = factor.solve(-states.gradient, -gradient)
        gain = -float(np.vdot(step, states.gradient) + shared @ gradient)
        if gain < PREDICTED_GAIN_TOLERANCE or iterations == MAX_ITERATIONS:
            break
        iterations += 1
        on_iteration()
        fraction = 1.0
        while fraction > MIN_STEP_FRACTION:
            moved = point.retract(fraction * step, fraction * shared)
            candidate = assemble_states(problem, moved)
            if candidate.cost < found.cost - 0.1 * fraction * gain:
                break
            fraction /= 2.0
        else:
            break
        decrease = found.cost - candidate.cost
        point, found = moved, candidate
        if decrease < COST_TOLERANCE:
            break
    return JointSolution(point, found, border, factor, problem, iterations)


def _moved(solution: JointSolution, times_s: FloatArray, latency_s: float) -> InertialStates:
    """States at other knots after the latency has grown: each instant now has a later stamp."""
    knots, samples = solution.point.knots, solution.equations.samples
    at_s = times_s - latency_s
    nearest = np.clip(np.searchsorted(knots.time_s, at_s), 0, len(knots) - 1)
    states = knots.select(nearest)
    delta_s = (at_s - knots.time_s[nearest])[:, None]
    rate, force = samples.at(knots.time_s[nearest])
    acceleration = matvec(states.rotation, force - states.bias_or_acceleration)
    acceleration = acceleration + solution.point.gravity.vector()
    return InertialStates(
        times_s,
        states.position + states.velocity * delta_s + 0.5 * acceleration * delta_s**2,
        states.rotation @ exp_so3((rate - states.gyro_bias) * delta_s),
        states.velocity + acceleration * delta_s,
        states.gyro_bias,
        states.bias_or_acceleration,
        states.wheels,
    )


def without_tilt(anchor: InertialAnchor) -> InertialAnchor:
    """Remove what an anchor says of the tilt, which is part of the set-up's prior here."""
    information = anchor.information.copy()
    information[-TILT_DIM:] = information[:, -TILT_DIM:] = 0.0
    return replace(anchor, information=information)


def states_of_imu(
    robot: States, stamps_s: FloatArray, setup: ImuSetup, gyro_bias: FloatArray
) -> InertialStates:
    """States of an IMU at stamps, from states of the robot at knots of which some are near."""
    at_s = stamps_s - setup.latency_s
    states = robot.select(nearest_knots(robot.time_s, at_s))
    delta_s = (at_s - states.time_s)[:, None]
    rotation = states.rotation @ exp_so3(states.angular_velocity * delta_s)
    mounting = setup.mounting
    arm = matvec(rotation, mounting.position)
    return InertialStates(
        stamps_s,
        states.position + states.velocity * delta_s + 0.5 * states.acceleration * delta_s**2 + arm,
        rotation @ mounting.rotation,
        states.velocity
        + states.acceleration * delta_s
        + matvec(rotation, cross(states.angular_velocity, mounting.position)),
        np.tile(gyro_bias, (len(stamps_s), 1)),
        np.zeros_like(arm),
        np.empty((len(stamps_s), 0)),
    )
