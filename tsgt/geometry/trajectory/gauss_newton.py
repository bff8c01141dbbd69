"""Maximum a posteriori trajectory by Gauss-Newton on states at knots; the solver of the estimator ``continuous``. Sans-I/O.

The loss is robust by iterative reweighting (IRLS); each step solves one block-tridiagonal system, with backtracking. After
S. Anderson and T. D. Barfoot, "Full STEAM ahead: exactly sparse Gaussian process regression for batch continuous-time
trajectory estimation on SE(3)", IROS 2015, with position in ``station1`` and rotation in the robot frame, each with its own
prior. docs/explanation/continuous-trajectory.md derives it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.rigid import dot, fast_log_so3, inverse_right_jacobian
from tsgt.geometry.trajectory.block_tridiagonal import BlockCholesky, factorise
from tsgt.geometry.trajectory.measurement_factors import linearise, squared_distances_at
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.geometry.trajectory.states import (
    STATE_DIM,
    ProcessFactors,
    States,
    add_process_factors,
    linearise_process,
    process_cost,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import LinearisedMeasurements, Observations
    from tsgt.model import MotionPrior

MIN_KNOT_SPACING_S = 0.02  # Within half of this the motion is described by velocity and acceleration
OUTLIER_THRESHOLD = 4.0
"""Mahalanobis distance (3 degrees of freedom) beyond which a measurement is an outlier: its weight falls with the
distance. 0.11 % of good measurements exceed it (chi-square of 16).
"""

REJECTION_THRESHOLD = 30.0
"""Mahalanobis distance from a converged trajectory beyond which a measurement gets no weight. Small weights add up: ten
measurements of a station on a wrong prism, 500 sigmas off, rotated a robot by 0.13 rad about the line through its other two.
"""

# Of a second search, where the first one left outliers beyond that threshold
COARSE_NOISE_SCALES = (20.0, 4.0)

INITIAL_VELOCITY_SIGMA_MPS = 10.0
INITIAL_ANGULAR_VELOCITY_SIGMA_RADPS = 10.0
INITIAL_POSITION_SIGMA_M = 1e4
INITIAL_ROTATION_SIGMA_RAD = 1e2  # Diffuse prior on the first knot
MAX_ITERATIONS = 30
COST_TOLERANCE = 1e-3  # The search converges when a step reduces the cost (minus twice a log density) by less
PREDICTED_GAIN_TOLERANCE = 1e-2
"""A step with a smaller predicted gain is the last one, without relinearisation: it moves the states by at most a tenth of a
sigma, and the derivatives by far less than the rounding of the result.
"""

LOOSE_GAIN_TOLERANCE = 3.0
"""The same on the way to other sigmas, where the next search starts. The gain of so small a step is as predicted to a percent."""

_MEASUREMENTS_PER_CHUNK, _FACTORS_PER_CHUNK = 128, 256  # Stay in the L1 cache: twice as fast
MIN_STEP_FRACTION = 1e-3  # Smallest fraction of a step that the line search tries


@dataclass(frozen=True, slots=True)
class AnchorPrior:
    """Gaussian prior on the first knot."""

    linearisation_point: States  # One knot about which the error is counted, close to the trajectory
    information: FloatArray  # (18, 18) inverse covariance of the error
    # (18,) mean of the error. In a direction with next to no information it may be metres or radians: as an error it keeps
    # that direction, as a retracted linearisation point it would not.
    mean: FloatArray = field(default_factory=lambda: np.zeros(STATE_DIM))


class Solution(NamedTuple):
    """The maximum a posteriori trajectory."""

    knots: States
    factor: BlockCholesky  # of the normal equations at the solution
    # (M,) squared Mahalanobis distance of each measurement's residual; 3 on average for good ones
    squared_distances: FloatArray
    weights: FloatArray  # (M,) of the robust loss, 1 for inliers
    linearised: LinearisedMeasurements  # at the solution
    knot_index: NDArray[np.intp]  # (M,) knot that each measurement is attached to
    cost: float  # Minus twice the log posterior density, up to a constant
    iterations: int
    process: ProcessFactors


class NormalEquations(NamedTuple):
    """Normal equations at a trajectory; fields not explained here are those of :class:`Solution`."""

    diagonal: FloatArray  # (K, 18, 18)
    off_diagonal: FloatArray  # (K - 1, 18, 18)
    gradient: FloatArray  # (K, 18)
    cost: float
    squared_distances: FloatArray
    weights: FloatArray
    linearised: LinearisedMeasurements
    whitened: FloatArray  # (M, 3, 19) whitened Jacobians and residuals, without the robust weights

    def factorised(self) -> tuple[BlockCholesky, NormalEquations]:
        """Factor of the matrix, and the equations without it: two matrices of a long trajectory take most of the memory."""
        factor = factorise(self.diagonal, self.off_diagonal)
        nothing = np.empty((0, STATE_DIM, STATE_DIM))
        return factor, self._replace(diagonal=nothing, off_diagonal=nothing)


def knot_times(time_s: FloatArray) -> FloatArray:
    """Choose knot times for measurements at times ``time_s``, (M,), in increasing order, at least one."""
    bins = np.unique(np.round(time_s / MIN_KNOT_SPACING_S).astype(np.int64))
    # The mean of its measurements' times: a single measurement has its knot exactly at its time.
    index = np.searchsorted(bins, np.round(time_s / MIN_KNOT_SPACING_S).astype(np.int64))
    times: FloatArray = np.bincount(index, time_s) / np.bincount(index)
    kept = np.concatenate([[True], np.diff(times) > 0.25 * MIN_KNOT_SPACING_S])
    return np.asarray(times[kept])


def nearest_knots(knots_s: FloatArray, time_s: FloatArray) -> NDArray[np.intp]:
    """(M,) index of the nearest knot in time."""
    if len(knots_s) == 1:
        return np.zeros(len(time_s), np.intp)
    after = np.minimum(np.maximum(np.searchsorted(knots_s, time_s), 1), len(knots_s) - 1)
    index: NDArray[np.intp] = after - (time_s - knots_s[after - 1] < knots_s[after] - time_s)
    return index


def diffuse_prior(first: States, prior: MotionPrior) -> AnchorPrior:
    """Prior on the first knot that carries next to no information, about an initial guess."""
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
    rest: FloatArray | None = None,
    max_iterations: int = MAX_ITERATIONS,
    gain_tolerance: float = PREDICTED_GAIN_TOLERANCE,
    reject_outliers: bool = True,
    on_iteration: Callable[[], None] = lambda: None,
) -> Solution:
    """Find the maximum a posteriori trajectory from observations in any order.

    ``guess``: states at the knot times of the result; rotations within about a radian of the solution. ``anchor``: prior on
    the first knot; diffuse when not given. ``sigmas``: (K - 1, 6) acceleration sigmas of each step instead of those of
    ``prior``; ``rest``: of :class:`ProcessFactors`. ``gain_tolerance``: see :data:`PREDICTED_GAIN_TOLERANCE`.
    ``reject_outliers``: solve a second time without measurements beyond :data:`REJECTION_THRESHOLD`; without, the solution is
    a smooth function of its inputs. ``on_iteration``: called before each; what it raises ends the search. Raises GeometryError: the
    measurements do not determine the trajectory.
    """
    anchor = diffuse_prior(guess.select(slice(0, 1)), prior) if anchor is None else anchor
    knot_index = nearest_knots(guess.time_s, observations.time_s)
    process = ProcessFactors.of(guess.time_s, prior, sigmas, rest)
    limits = max_iterations, gain_tolerance, on_iteration
    found = _minimise(observations, knot_index, guess, process, anchor, *limits)
    if not reject_outliers or not (found.squared_distances > REJECTION_THRESHOLD**2).any():
        return found
    # The guess of a rotation across the outage of a prism may lead to a local minimum, where good measurements are outliers.
    if max_iterations >= MAX_ITERATIONS:
        coarse = guess
        for scale in COARSE_NOISE_SCALES:
            rough = replace(observations, sigmas_m=scale * observations.sigmas_m)
            coarse = _minimise(rough, knot_index, coarse, process, anchor, *limits).knots
        found = min(
            found,
            _minimise(observations, knot_index, coarse, process, anchor, *limits),
            key=lambda solution: solution.cost,
        )
    # Only after convergence: far from the solution, good measurements exceed the threshold too.
    rejectable = np.ones(len(knot_index), np.bool_)
    second = _minimise(observations, knot_index, found.knots, process, anchor, *limits, rejectable)
    return second._replace(iterations=max(found.iterations, second.iterations))


def _minimise(
    observations: Observations,
    knot_index: NDArray[np.intp],
    knots: States,
    process: ProcessFactors,
    anchor: AnchorPrior,
    max_iterations: int,
    gain_tolerance: float,
    on_iteration: Callable[[], None],
    rejectable: NDArray[np.bool_] | None = None,
) -> Solution:
    """Run Gauss-Newton with backtracking until the cost or the predicted gain falls below its tolerance."""

    def evaluate(knots: States) -> NormalEquations:
        return assemble(observations, knot_index, knots, process, anchor, rejectable=rejectable)

    def cost_at(knots: States) -> float:
        squares = squared_distances_at(observations, knots, knot_index)
        measured = float(robust_loss(squares, rejectable=rejectable)[1].sum())
        return measured + process_cost(knots, process) + _anchor_cost(knots, anchor)

    iterations = 0
    factor, system = evaluate(knots).factorised()
    shortened = False
    while iterations < max_iterations:
        on_iteration()
        iterations += 1
        step = factor.solve(-system.gradient)
        if -float(np.vdot(step, system.gradient)) < gain_tolerance:
            knots, system = knots.retract(step), apply_linear_step(system, knot_index, step)
            break
        moved, candidate = knots.retract(step), None
        # After a step that had to be shortened the next one is likely to be too.
        if not shortened:
            candidate = evaluate(moved)
            shortened = not candidate.cost < system.cost + 0.1 * float(np.vdot(step, system.gradient))
        if candidate is None or shortened:
            fraction = _line_search(cost_at, knots, step, system, 1.0 if candidate is None else 0.5)
            if fraction is None:
                break
            moved, shortened = knots.retract(fraction * step), fraction < 1.0
            candidate = evaluate(moved)
        decrease = system.cost - candidate.cost
        knots = moved
        factor, system = candidate.factorised()
        del candidate
        if decrease < COST_TOLERANCE:
            break
    found = system.squared_distances, system.weights, system.linearised, knot_index, system.cost
    return Solution(knots, factor, *found, iterations, process)


def _line_search(
    cost_at: Callable[[States], float],
    knots: States,
    step: FloatArray,
    system: NormalEquations,
    fraction: float,
) -> float | None:
    """Halve a fraction of a step until the cost decreases sufficiently; None where rounding hides any decrease."""
    predicted_decrease = -float(np.vdot(step, system.gradient))
    while fraction > MIN_STEP_FRACTION:
        if cost_at(knots.retract(fraction * step)) < system.cost - 0.1 * fraction * predicted_decrease:
            return fraction
        fraction /= 2.0
    return None


def assemble(
    observations: Observations,
    knot_index: NDArray[np.intp],
    knots: States,
    process: ProcessFactors,
    anchor: AnchorPrior,
    *,
    active: NDArray[np.bool_] | None = None,
    rejectable: NDArray[np.bool_] | None = None,
) -> NormalEquations:
    """Assemble the normal equations at a trajectory.

    Each of the M measurements is attached to the knot ``knot_index``. One that is not ``active`` gets no weight and no
    cost; one that is ``rejectable`` none beyond :data:`REJECTION_THRESHOLD`, unless half of all are outliers. By
    default all are active and none is rejectable; reject only at a converged trajectory.
    """
    linearised = linearise(observations, knots, knot_index)
    whitened = linearised.whitened(observations)
    squared_distances = dot(whitened[:, :, 18], whitened[:, :, 18])
    weights, loss = robust_loss(squared_distances, active=active, rejectable=rejectable)

    diagonal, off_diagonal = (
        np.zeros((len(knots), STATE_DIM, STATE_DIM)),
        np.zeros((len(knots) - 1, STATE_DIM, STATE_DIM)),
    )
    gradient = np.zeros((len(knots), STATE_DIM))
    add_measurements(whitened, weights, knot_index, diagonal, gradient)
    cost = float(loss.sum())
    first, reference = knots.select(slice(0, 1)), anchor.linearisation_point
    rotvec, by_rotation = None, None
    for start in range(0, len(off_diagonal), _FACTORS_PER_CHUNK):
        chunk, chunk_knots = (
            slice(start, start + _FACTORS_PER_CHUNK),
            slice(start, start + _FACTORS_PER_CHUNK + 1),
        )
        chunk_process = process.select(chunk)
        linearised_process = linearise_process(
            knots.select(chunk_knots), chunk_process, None if start else reference.rotation
        )
        rotvec, by_rotation = linearised_process.from_given or (rotvec, by_rotation)
        cost += add_process_factors(
            linearised_process,
            chunk_process,
            diagonal[chunk_knots],
            off_diagonal[chunk],
            gradient[chunk_knots],
        )

    if rotvec is None or by_rotation is None:  # a single knot
        rotvec = fast_log_so3(reference.rotation.swapaxes(1, 2) @ first.rotation)[0]
        by_rotation = inverse_right_jacobian(rotvec)
    error = first.differences_from(reference, rotvec[None])[0]
    by_error = np.eye(STATE_DIM)
    by_error[3:6, 3:6] = by_rotation
    error -= anchor.mean
    weighted = by_error.T @ anchor.information
    diagonal[0] += weighted @ by_error
    gradient[0] += weighted @ error
    cost += float(error @ anchor.information @ error)
    return NormalEquations(
        diagonal, off_diagonal, gradient, cost, squared_distances, weights, linearised, whitened
    )


def _anchor_cost(knots: States, anchor: AnchorPrior) -> float:
    error = knots.select(slice(0, 1)).local_coordinates_about(anchor.linearisation_point)[0] - anchor.mean
    return float(error @ anchor.information @ error)


def robust_loss(
    squared_distances: FloatArray,
    *,
    active: NDArray[np.bool_] | None = None,
    rejectable: NDArray[np.bool_] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Weights and losses of M measurements from their squared Mahalanobis distances; masks as for :func:`assemble`."""
    ratio = np.maximum(squared_distances / OUTLIER_THRESHOLD**2, 1.0)
    weights = 1.0 / ratio
    loss = np.minimum(squared_distances, OUTLIER_THRESHOLD**2)
    has_outliers = bool((ratio > 1.0).any())
    if has_outliers:
        loss += OUTLIER_THRESHOLD**2 * np.log(ratio)
    # Where most measurements are outliers the trajectory or the set-up is wrong, not the measurements.
    if has_outliers and rejectable is not None and 2 * np.count_nonzero(ratio == 1.0) > len(ratio):
        rejected = rejectable & (squared_distances > REJECTION_THRESHOLD**2)
        weights[rejected] = 0.0
        loss[rejected] = OUTLIER_THRESHOLD**2 * (
            1.0 + 2.0 * math.log(REJECTION_THRESHOLD / OUTLIER_THRESHOLD)
        )
    if active is not None:
        weights[~active] = loss[~active] = 0.0
    return weights, loss


def add_measurements(
    whitened: FloatArray,
    weights: FloatArray,
    knot_index: NDArray[np.intp],
    diagonal: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add measurements, whitened, (M, 3, B + 1), and weighted, (M,), to the normal equations of blocks of B, in place."""
    size = diagonal.shape[-1]
    if len(knot_index) <= _MEASUREMENTS_PER_CHUNK and (knot_index[1:] > knot_index[:-1]).all():
        # Most windows of a fixed lag: one measurement of each knot, in their order.
        normal = (whitened * weights[:, None, None]).swapaxes(1, 2) @ whitened
        diagonal[knot_index] += normal[:, :size, :size]
        gradient[knot_index] += normal[:, :size, size]
        return
    order = np.argsort(knot_index, kind="stable")
    for start in range(0, len(knot_index), _MEASUREMENTS_PER_CHUNK):
        chunk = order[start : start + _MEASUREMENTS_PER_CHUNK]
        chunk_whitened, chunk_knots = whitened[chunk], knot_index[chunk]
        normal = np.swapaxes(chunk_whitened * weights[chunk, None, None], 1, 2) @ chunk_whitened
        # Indexed addition ignores repeated knots: add the first measurement of each knot, then the second, ...
        occurrence = np.arange(len(chunk_knots)) - np.searchsorted(chunk_knots, chunk_knots)
        for number in range(int(occurrence.max()) + 1):
            selected = occurrence == number
            diagonal[chunk_knots[selected]] += normal[selected, :size, :size]
            gradient[chunk_knots[selected]] += normal[selected, :size, size]


def apply_linear_step(
    system: NormalEquations, knot_index: NDArray[np.intp], step: FloatArray
) -> NormalEquations:
    """Apply a small step to residuals, weights and cost; Jacobians and predicted prism states stay those before the step."""
    steps = step[knot_index][:, :, None]
    linearised = system.linearised
    residuals_m = linearised.residuals_m + (linearised.jacobian @ steps)[:, :, 0]
    residuals = system.whitened[:, :, 18] + (system.whitened[:, :, :18] @ steps)[:, :, 0]
    squared_distances = dot(residuals, residuals)
    return system._replace(
        linearised=replace(linearised, residuals_m=residuals_m),
        squared_distances=squared_distances,
        # Keep weights consistent with the distances.
        weights=(system.weights > 0) / np.maximum(squared_distances / OUTLIER_THRESHOLD**2, 1.0),
        cost=system.cost + float(np.vdot(step, system.gradient)),
    )


def log_evidence(
    solution: Solution, observations: Observations, prior: MotionPrior, step_sigmas: FloatArray | None = None
) -> float:
    """Log evidence of a prior: logarithm of the measurements' density, trajectory integrated out (Laplace approximation).

    Terms common to all priors are omitted; compare only with the same measurements, noise and intervals of rest.
    ``step_sigmas``, (K - 1, 6): as in :func:`solve`.
    """
    sigmas = axis_sigmas(prior)
    if step_sigmas is None:
        step_sigmas = np.repeat(sigmas[None], len(solution.process.information), axis=0)
    # Axes of one kind differ only in sigma.
    _, step_logdet = np.linalg.slogdet(solution.process.information[:, ::3])
    process_logdet = 3.0 * float(step_logdet.sum()) + 6.0 * float(
        3.0 * np.log(step_sigmas[:, ::3]).sum() - np.log(step_sigmas).sum()
    )
    _, noise_logdet = np.linalg.slogdet(solution.linearised.covariance(observations))
    anchor_logdet = -2.0 * float(np.log(sigmas).sum())
    return -0.5 * (
        solution.cost
        + solution.factor.log_determinant()
        - process_logdet
        - anchor_logdet
        + float(noise_logdet.sum())
    )
