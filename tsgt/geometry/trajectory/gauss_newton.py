"""The estimator ``continuous``: one smooth trajectory through raw measurements at their own times. Pure.

Prior: the robot's accelerations (:mod:`tsgt.geometry.trajectory.motion_prior`). Likelihood: range and two angles of each measurement
through the rigid robot (:mod:`tsgt.geometry.trajectory.measurement_factors`). The most probable trajectory is found by Gauss and Newton's
method with halved steps on the states at the knots; each step solves one block tridiagonal system
(:mod:`tsgt.geometry.trajectory.block_tridiagonal`), whose inverse's blocks are the covariances. After S. Anderson and T. D. Barfoot, "Full
STEAM ahead: exactly sparse Gaussian process regression for batch continuous-time trajectory estimation on SE(3)", IROS
2015, with the position in frame ``station1`` and the rotation in the robot's frame, each with its own prior.
docs/explanation/continuous-trajectory.md derives it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.rigid import dot, inverse_right_jacobian
from tsgt.geometry.trajectory.block_tridiagonal import BlockCholesky, factorise
from tsgt.geometry.trajectory.measurement_factors import linearise
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.geometry.trajectory.states import (
    STATE_DIM,
    ProcessFactors,
    States,
    add_process_factors,
    linearise_process,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import LinearisedMeasurements, Observations
    from tsgt.model import MotionPrior

MIN_KNOT_SPACING_S = 0.02
"""Knots are no closer: within half of this a robot's motion is told by velocity and acceleration."""

OUTLIER_THRESHOLD = 4.0
"""In sigmas of three dimensions: farther from the trajectory than this, a measurement counts the less the farther it is.
One in a thousand good ones is (chi-square, 3 degrees of freedom: 16 is passed by 0.11 %)."""

REJECTION_THRESHOLD = 30.0
"""In sigmas: farther than this from a trajectory that has been found, a measurement has no say at all. Little says add up: ten
of a station on a wrong prism, 500 sigmas off, had turned a robot by 0.13 rad about the line through its other two prisms."""

INITIAL_VELOCITY_SIGMA_MPS = 10.0
INITIAL_ANGULAR_VELOCITY_SIGMA_RADPS = 10.0
"""One sigma of a robot's first velocity in m/s and of its turning in rad/s."""

INITIAL_POSITION_SIGMA_M = 1e4
INITIAL_ROTATION_SIGMA_RAD = 1e2
"""One sigma of the first pose: none that tells anything."""

MAX_ITERATIONS = 30
COST_TOLERANCE = 1e-3
"""Less gain in cost (minus twice a log density) than this ends the search."""

PREDICTED_GAIN_TOLERANCE = 1e-2
"""A step that promises less gain than this is the last one, and nothing is linearised again after it: all that it changes is a
tenth of a sigma, and what that changes in the derivatives is far below rounding of the result."""

_ROWS_AT_ONCE, _STEPS_AT_ONCE = 128, 256
"""What is made of so many measurements or steps stays in the nearest cache until it is added up: twice as fast as all at once."""

MIN_STEP_FRACTION = 1e-3
"""A step is halved until it helps, but not below this."""


@dataclass(frozen=True, slots=True)
class AnchorPrior:
    """What is known of the first knot besides the measurements.

    Attributes
    ----------
    near
        One knot, where its error counts from; close to where the trajectory is.
    information
        (18, 18) inverse covariance of that error.
    expected
        (18,) its mean. What is known only with what comes later may be far off here, metres and radians in a direction of
        which the information is next to nothing: as an error it stays in that direction, as another knot it would not.
    """

    near: States
    information: FloatArray
    expected: FloatArray = field(default_factory=lambda: np.zeros(STATE_DIM))


class Solution(NamedTuple):
    """The most probable trajectory.

    Attributes
    ----------
    knots
        States.
    factor
        Of the system at the solution.
    distances
        (M,) squared distances of the measurements from the trajectory, in sigmas; good ones have 3 on average.
    weights
        (M,) what each measurement counts, 1 for those that are no outliers.
    linearised
        Measurements at the solution.
    at
        (M,) which knot each of them is near.
    cost
        Minus twice the logarithm of the posterior density, less what does not depend on the trajectory.
    iterations
        How many steps it took.
    steps
        What the prior says of the steps between the knots.
    """

    knots: States
    factor: BlockCholesky
    squared_distances: FloatArray
    weights: FloatArray
    linearised: LinearisedMeasurements
    at: NDArray[np.intp]
    cost: float
    iterations: int
    steps: ProcessFactors


class NormalEquations(NamedTuple):
    """The normal equations at some trajectory.

    Attributes
    ----------
    diagonal, beside, gradient
        (K, 18, 18), (K - 1, 18, 18) and (K, 18).
    cost, distances, weights, linearised
        As in :class:`Solution`.
    rows
        (M, 3, 19) derivatives of the measurements' residuals and these, in sigmas, weights left out.
    """

    diagonal: FloatArray
    off_diagonal: FloatArray
    gradient: FloatArray
    cost: float
    squared_distances: FloatArray
    weights: FloatArray
    linearised: LinearisedMeasurements
    rows: FloatArray


def knot_times(time_s: FloatArray, *, min_spacing_s: float = MIN_KNOT_SPACING_S) -> FloatArray:
    """Choose the instants of knots for measurements at some instants, in the order of time.

    Parameters
    ----------
    time_s
        (M,) in s, at least one.
    least_step_s
        Knots are no closer.
    """
    slots = np.unique(np.round(time_s / min_spacing_s).astype(np.int64))
    # The mean of its measurements' times, so that one alone has its knot exactly there.
    index = np.searchsorted(slots, np.round(time_s / min_spacing_s).astype(np.int64))
    times: FloatArray = np.bincount(index, time_s) / np.bincount(index)
    kept = np.concatenate([[True], np.diff(times) > 0.25 * min_spacing_s])
    return np.asarray(times[kept])


def nearest_knots(knots_s: FloatArray, time_s: FloatArray) -> NDArray[np.intp]:
    """(M,) which knot is nearest in time."""
    if len(knots_s) == 1:
        return np.zeros(len(time_s), np.intp)
    after = np.minimum(np.maximum(np.searchsorted(knots_s, time_s), 1), len(knots_s) - 1)
    found: NDArray[np.intp] = after - (time_s - knots_s[after - 1] < knots_s[after] - time_s)
    return found


def diffuse_prior(first: States, prior: MotionPrior) -> AnchorPrior:
    """Return what is known of a robot of which nothing is known yet, about a first guess."""
    sigmas = np.concatenate(
        [
            np.full(3, INITIAL_POSITION_SIGMA_M),
            np.full(3, INITIAL_ROTATION_SIGMA_RAD),
            np.full(3, INITIAL_VELOCITY_SIGMA_MPS),
            np.full(3, INITIAL_ANGULAR_VELOCITY_SIGMA_RADPS),
            axis_sigmas(prior),
        ]
    )
    zero = np.zeros((1, 3))
    return AnchorPrior(
        States(first.time_s, first.position, first.rotation, zero, zero, zero, zero), np.diag(sigmas**-2.0)
    )


def solve(
    observations: Observations,
    guess: States,
    prior: MotionPrior,
    *,
    anchor: AnchorPrior | None = None,
    sigmas: FloatArray | None = None,
    max_iterations: int = MAX_ITERATIONS,
    reject_outliers: bool = True,
) -> Solution:
    """Find the most probable trajectory.

    Parameters
    ----------
    observations
        Measurements, in any order.
    guess
        States to begin with; their instants are those of the result's knots. Rotations must be right to about a radian.
    prior
        How the robot may move.
    anchor
        What is known of the first knot; nothing when not given.
    sigmas
        (K - 1, 6) one sigma of the acceleration of each axis in each step; those of ``prior`` when not given.
    most_iterations
        After so many steps it ends where it is.
    hopeless_heard
        Whether what is :data:`REJECTION_THRESHOLD` keeps its say: what is found then changes smoothly with all that it is found from.

    Raises
    ------
    GeometryError
        The measurements do not determine the trajectory.
    """
    anchor = diffuse_prior(guess.select(slice(0, 1)), prior) if anchor is None else anchor
    at = nearest_knots(guess.time_s, observations.time_s)
    steps = ProcessFactors.of(guess.time_s, prior, sigmas)
    found = _descended(observations, at, guess, steps, anchor, max_iterations)
    if not reject_outliers or not (found.squared_distances > REJECTION_THRESHOLD**2).any():
        return found
    # Only now: from a guess that is far off, good measurements seem hopeless.
    rejectable = np.ones(len(at), np.bool_)
    again = _descended(observations, at, found.knots, steps, anchor, max_iterations, rejectable)
    return again._replace(iterations=max(found.iterations, again.iterations))


def _descended(
    observations: Observations,
    at: NDArray[np.intp],
    knots: States,
    steps: ProcessFactors,
    anchor: AnchorPrior,
    max_iterations: int,
    rejectable: NDArray[np.bool_] | None = None,
) -> Solution:
    iterations = 0
    system = assemble(observations, at, knots, steps, anchor, rejectable=rejectable)
    factor = factorise(system.diagonal, system.off_diagonal)
    while iterations < max_iterations:
        iterations += 1
        move = factor.solve(-system.gradient)
        if -float(np.vdot(move, system.gradient)) < PREDICTED_GAIN_TOLERANCE:
            knots, system = knots.retract(move), nudged(system, at, move)
            break
        tried, following = _searched(observations, at, knots, move, system, steps, anchor, rejectable)
        if tried is None:
            break
        gained = system.cost - tried.cost
        knots, system = following, tried
        factor = factorise(system.diagonal, system.off_diagonal)
        if gained < COST_TOLERANCE:
            break
    return Solution(
        knots,
        factor,
        system.squared_distances,
        system.weights,
        system.linearised,
        at,
        system.cost,
        iterations,
        steps,
    )


def _searched(
    observations: Observations,
    at: NDArray[np.intp],
    knots: States,
    move: FloatArray,
    system: NormalEquations,
    steps: ProcessFactors,
    anchor: AnchorPrior,
    rejectable: NDArray[np.bool_] | None,
) -> tuple[NormalEquations | None, States]:
    """Go so far along a move that the cost falls; None where it does not on any way that rounding leaves visible.

    Half of a step is better than a damped one here: damping by the diagonal would hold the whole stiff chain of knots
    for the sake of one that turned too far.
    """
    promised = -float(np.vdot(move, system.gradient))
    share = 1.0
    while share > MIN_STEP_FRACTION:
        following = knots.retract(share * move)
        tried = assemble(observations, at, following, steps, anchor, rejectable=rejectable)
        if tried.cost < system.cost - 0.1 * share * promised:
            return tried, following
        share /= 2.0
    return None, knots


def assemble(
    observations: Observations,
    at: NDArray[np.intp],
    knots: States,
    steps: ProcessFactors,
    anchor: AnchorPrior,
    *,
    active: NDArray[np.bool_] | None = None,
    rejectable: NDArray[np.bool_] | None = None,
) -> NormalEquations:
    """Make the normal equations at some trajectory.

    Parameters
    ----------
    observations, knots, steps, anchor
        The problem.
    at
        (M,) which knot each measurement is near.
    unheard
        (M,) measurements that have no say yet.
    heard
        (M,) measurements that have a say however far off they are; all where not given. Of the others, what is
        :data:`REJECTION_THRESHOLD` has none, which can be said only where the trajectory is no guess any more.
    """
    linearised = linearise(observations, knots, at)
    rows = linearised.whitened(observations)
    squared_distances = dot(rows[:, :, 18], rows[:, :, 18])
    ratio = np.maximum(squared_distances / OUTLIER_THRESHOLD**2, 1.0)
    weights = 1.0 / ratio
    capped = np.minimum(squared_distances, OUTLIER_THRESHOLD**2) + OUTLIER_THRESHOLD**2 * np.log(ratio)
    # Nothing is hopeless beside others that do not fit either: then the trajectory is wrong, or the set-up.
    if rejectable is not None and 2 * np.count_nonzero(ratio == 1.0) > len(ratio):
        rejected = rejectable & (squared_distances > REJECTION_THRESHOLD**2)
        weights[rejected] = 0.0
        capped[rejected] = OUTLIER_THRESHOLD**2 * (
            1.0 + 2.0 * math.log(REJECTION_THRESHOLD / OUTLIER_THRESHOLD)
        )
    if active is not None:
        weights[~active] = capped[~active] = 0.0

    diagonal, off_diagonal = (
        np.zeros((len(knots), STATE_DIM, STATE_DIM)),
        np.zeros((len(knots) - 1, STATE_DIM, STATE_DIM)),
    )
    gradient = np.zeros((len(knots), STATE_DIM))
    add_rows(rows, weights, at, diagonal, gradient)
    cost = float(capped.sum())
    for start in range(0, len(off_diagonal), _STEPS_AT_ONCE):
        some, ends = slice(start, start + _STEPS_AT_ONCE), slice(start, start + _STEPS_AT_ONCE + 1)
        few = steps.select(some)
        between = linearise_process(knots.select(ends), few)
        cost += add_process_factors(between, few, diagonal[ends], off_diagonal[some], gradient[ends])

    error = knots.select(slice(0, 1)).local_coordinates_about(anchor.near)[0]
    by_error = np.eye(STATE_DIM)
    by_error[3:6, 3:6] = inverse_right_jacobian(error[3:6])
    error -= anchor.expected
    pull = by_error.T @ anchor.information
    diagonal[0] += pull @ by_error
    gradient[0] += pull @ error
    cost += float(error @ anchor.information @ error)
    return NormalEquations(
        diagonal, off_diagonal, gradient, cost, squared_distances, weights, linearised, rows
    )


def add_rows(
    rows: FloatArray, weights: FloatArray, at: NDArray[np.intp], diagonal: FloatArray, gradient: FloatArray
) -> None:
    """Add measurements, (M, 3, 19) as in :class:`NormalEquations`, to normal equations, in which each counts its weight, (M,)."""
    by_knot = np.argsort(at, kind="stable")
    for start in range(0, len(at), _ROWS_AT_ONCE):
        some = by_knot[start : start + _ROWS_AT_ONCE]
        few, near = rows[some], at[some]
        normal = np.swapaxes(few * weights[some, None, None], 1, 2) @ few
        # Most knots have one measurement: the first of each knot at once, then the second ones.
        place = np.arange(len(near)) - np.searchsorted(near, near)
        for each in range(int(place.max()) + 1):
            now = place == each
            diagonal[near[now]] += normal[now, :STATE_DIM, :STATE_DIM]
            gradient[near[now]] += normal[now, :STATE_DIM, STATE_DIM]


def nudged(system: NormalEquations, at: NDArray[np.intp], move: FloatArray) -> NormalEquations:
    """Give measurements' residuals and the cost after the whole of a move so small that no derivative changes by it.

    Derivatives, and where the prisms are and how fast, stay those of before it.
    """
    moves = move[at][:, :, None]
    linearised = system.linearised
    residuals_m = linearised.residuals_m + (linearised.jacobian @ moves)[:, :, 0]
    off = system.rows[:, :, 18] + (system.rows[:, :, :18] @ moves)[:, :, 0]
    squared_distances = dot(off, off)
    return system._replace(
        linearised=replace(linearised, residuals_m=residuals_m),
        squared_distances=squared_distances,
        # So that what is named an outlier is as far off as it is said to be.
        weights=(system.weights > 0) / np.maximum(squared_distances / OUTLIER_THRESHOLD**2, 1.0),
        cost=system.cost + float(np.vdot(move, system.gradient)),
    )


def log_evidence(solution: Solution, observations: Observations, prior: MotionPrior) -> float:
    """How well a prior explains the measurements: logarithm of their density, trajectory integrated out (Laplace).

    Terms that are the same for all priors are left out; measurements and noise must be the same where two are compared.
    """
    sigmas = axis_sigmas(prior)
    # Axes of one kind differ by their sigma alone.
    _, step_logdet = np.linalg.slogdet(solution.steps.information[:, ::3])
    steps_logdet = 3.0 * float(step_logdet.sum()) + 6.0 * len(step_logdet) * float(
        np.log(sigmas[::3]).sum() * 3.0 - np.log(sigmas).sum()
    )
    _, noise_logdet = np.linalg.slogdet(solution.linearised.covariance(observations))
    anchor_logdet = -2.0 * float(np.log(sigmas).sum())
    return -0.5 * (
        solution.cost
        + solution.factor.log_determinant()
        - steps_logdet
        - anchor_logdet
        + float(noise_logdet.sum())
    )
