"""Maximum a posteriori trajectory with an IMU, by Gauss-Newton on states at knots. Sans-I/O.

The search and the treatment of outliers are those of ``geometry.trajectory.gauss_newton``; what differs are the factors between
knots, the tilt of gravity and the accelerometer's matrix, which border the system, and the integration of the samples, which is repeated where the bias of the
gyro has moved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.inertial.anchor import InertialAnchor
from tsgt.geometry.inertial.bordered import BorderedCholesky, factorise_bordered
from tsgt.geometry.inertial.factors import (
    InertialEquations,
    InertialFactors,
    assemble_inertial,
    inertial_costs,
)
from tsgt.geometry.rigid import dot
from tsgt.geometry.trajectory.gauss_newton import (
    COARSE_NOISE_SCALES,
    COST_TOLERANCE,
    INITIAL_POSITION_SIGMA_M,
    INITIAL_ROTATION_SIGMA_RAD,
    INITIAL_VELOCITY_SIGMA_MPS,
    LOOSE_GAIN_TOLERANCE,
    MAX_ITERATIONS,
    MIN_STEP_FRACTION,
    OUTLIER_THRESHOLD,
    PREDICTED_GAIN_TOLERANCE,
    REJECTION_THRESHOLD,
    knot_times,
    nearest_knots,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.odometry import Odometry
    from tsgt.geometry.inertial.preintegration import ContiguousSamples, Preintegrated
    from tsgt.geometry.inertial.states import Gravity, InertialStates
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import LinearisedMeasurements, Observations
    from tsgt.model import ImuNoise, MotionPrior

MAX_KNOT_SPACING_S = 0.5
"""Knots without measurements are inserted into longer gaps: within one step the biases are constant."""

MAX_BIAS_ROTATION_RAD = 2e-3
"""Rotation by a change of the gyro's bias over a step beyond which it is integrated again. To first order the correction
is wrong by half its square.
"""

FAR_GAIN = 1e4
"""Predicted gain of a step beyond which it does not lead to the minimum yet: there the samples need not be integrated again."""

MAX_KNOTS_TOGETHER = 2048  # Whose costs are computed in one pass: bounds the memory

_FRACTIONS = tuple(0.5**n for n in range(int(-math.log2(MIN_STEP_FRACTION)) + 1))
"""Of a step, that the search along it tries."""


@dataclass(frozen=True, slots=True)
class InertialSetup:
    """Samples of an IMU and how they are used."""

    samples: ContiguousSamples
    noise: ImuNoise  # That of the samples' densities
    gyro_only: MotionPrior | None = (
        None  # Prior of the motion of the states' origin, in place of specific forces
    )
    odometry: Odometry | None = None  # With states that have wheels

    def factors(self, knots: InertialStates, found: Preintegrated | None = None) -> InertialFactors:
        """Return the factors between knots; ``found``: preintegrated about their biases already."""
        return InertialFactors.of(
            self.samples, knots, self.noise, gyro_only=self.gyro_only, odometry=self.odometry, found=found
        )


class InertialSolution(NamedTuple):
    """The maximum a posteriori trajectory; fields not explained here are those of the solution without IMU."""

    knots: InertialStates
    gravity: Gravity
    factor: BorderedCholesky
    squared_distances: FloatArray
    weights: FloatArray
    linearised: LinearisedMeasurements
    knot_index: NDArray[np.intp]
    cost: float
    iterations: int
    factors: InertialFactors


def inertial_knot_times(time_s: FloatArray) -> FloatArray:
    """Choose knot times for measurements at times ``time_s``, at least one."""
    times_s = knot_times(time_s)
    steps = np.ceil(np.diff(times_s) / MAX_KNOT_SPACING_S - 1e-9).astype(np.int64)
    parts = [
        times_s[i] + (times_s[i + 1] - times_s[i]) * np.arange(1, steps[i]) / steps[i]
        for i in np.flatnonzero(steps > 1)
    ]
    return np.sort(np.concatenate([times_s, *parts]))


def diffuse_inertial_prior(
    first: InertialStates,
    gravity: Gravity,
    noise: ImuNoise,
    gyro_only: MotionPrior | None = None,
    odometry: Odometry | None = None,
) -> InertialAnchor:
    """Prior on the first knot that carries next to no information, but for the biases, and on what all knots share."""
    of_last = (
        np.full(3, noise.accelerometer_bias_mps2) if gyro_only is None else gyro_only.acceleration_sigma_mps2
    )
    sigmas = np.concatenate(
        [
            np.full(3, INITIAL_POSITION_SIGMA_M),
            np.full(3, INITIAL_ROTATION_SIGMA_RAD),
            np.full(3, INITIAL_VELOCITY_SIGMA_MPS),
            np.full(3, noise.gyro_bias_radps),
            of_last,
            np.empty(0) if odometry is None else odometry.prior_sigmas(),
            gravity.prior_sigmas(),
        ]
    )
    zero = np.zeros((1, 3))
    about = replace(
        first,
        velocity=zero,
        gyro_bias=zero,
        bias_or_acceleration=zero,
        wheels=np.zeros_like(first.wheels),
    )
    return InertialAnchor(about, np.zeros(gravity.dim), np.diag(sigmas**-2.0), np.zeros(len(sigmas)))


def solve_inertial(
    observations: Observations,
    setup: InertialSetup,
    guess: InertialStates,
    gravity: Gravity,
    *,
    anchor: InertialAnchor | None = None,
    factors: InertialFactors | None = None,
    max_iterations: int = MAX_ITERATIONS,
    gain_tolerance: float = PREDICTED_GAIN_TOLERANCE,
    reject_outliers: bool = True,
) -> InertialSolution:
    """Find the maximum a posteriori trajectory from observations in any order.

    ``observations``: with the layout in the IMU's axes, from its origin. ``guess``: states at the knot times of the result,
    rotations within about half a radian of the solution. ``anchor``: prior on the first knot and what all knots share; diffuse when not
    given. ``factors``: between the knots of the guess, when they are at hand. ``gain_tolerance``: as without an IMU. Raises GeometryError: the measurements do not
    determine the trajectory.
    """
    if anchor is None:
        anchor = diffuse_inertial_prior(
            guess.select(slice(0, 1)), gravity, setup.noise, setup.gyro_only, setup.odometry
        )
    if factors is None:
        factors = setup.factors(guess)
    knot_index = nearest_knots(guess.time_s, observations.time_s)
    kinematics = setup.samples.at(guess.time_s)
    search = _Search(observations, knot_index, setup, anchor, kinematics, gain_tolerance)
    found = search.minimise(guess, gravity, factors, max_iterations)
    if not reject_outliers or not (found.squared_distances > REJECTION_THRESHOLD**2).any():
        return found
    # As without an IMU: good measurements are outliers of a local minimum, which a coarse search leaves.
    if max_iterations >= MAX_ITERATIONS:
        coarse = guess
        loose = replace(search, gain_tolerance=LOOSE_GAIN_TOLERANCE)
        for scale in COARSE_NOISE_SCALES:
            rough = replace(loose, observations=replace(observations, sigmas_m=scale * observations.sigmas_m))
            coarse = rough.minimise(coarse, gravity, factors, max_iterations).knots
        again = loose.minimise(coarse, gravity, factors, max_iterations)
        found = min(found, again, key=lambda solution: solution.cost)
    rejectable = np.ones(len(knot_index), np.bool_)
    second = replace(search, rejectable=rejectable).minimise(
        found.knots, found.gravity, found.factors, max_iterations
    )
    return second._replace(iterations=max(found.iterations, second.iterations))


@dataclass(frozen=True, slots=True)
class _Search:
    """One search for the minimum of the cost."""

    observations: Observations
    knot_index: NDArray[np.intp]
    setup: InertialSetup
    anchor: InertialAnchor
    kinematics: tuple[FloatArray, FloatArray]  # angular rate and specific force at the knots
    gain_tolerance: float
    rejectable: NDArray[np.bool_] | None = None

    def minimise(
        self, knots: InertialStates, gravity: Gravity, factors: InertialFactors, max_iterations: int
    ) -> InertialSolution:
        """Run Gauss-Newton with backtracking until the cost or the predicted gain falls below its tolerance."""
        iterations = 0
        factors = self._integrated_again(knots, factors)
        system = self._evaluate(knots, gravity, factors)
        factor = factorise(system)
        far = shortened = False
        while iterations < max_iterations:
            iterations += 1
            step, shared = factor.solve(-system.gradient, -system.corner_gradient)
            gain = -float(np.vdot(step, system.gradient) + np.vdot(shared, system.corner_gradient))
            if gain < self.gain_tolerance:
                if far and (integrated := self._integrated_again(knots, factors)) is not factors:
                    factors, far = integrated, False
                    system = self._evaluate(knots, gravity, factors)
                    factor = factorise(system)
                    continue
                knots, gravity = knots.retract(step), gravity.retract(shared)
                system = apply_linear_step(system, self.knot_index, step, gain)
                break
            moved, moved_gravity = knots.retract(step), gravity.retract(shared)
            # After a step that had to be shortened the next one is likely to be too.
            candidate = None if shortened else self._evaluate(moved, moved_gravity, factors)
            shortened = candidate is None or not candidate.cost < system.cost - 0.1 * gain
            if candidate is None or shortened:
                tried = _FRACTIONS if candidate is None else _FRACTIONS[1:]
                shorter = self._along(knots, gravity, factors, step, shared, tried, system.cost, gain)
                if shorter is None:
                    break
                moved, moved_gravity, shortened = shorter
                candidate = self._evaluate(moved, moved_gravity, factors)
            decrease = system.cost - candidate.cost
            knots, gravity, system = moved, moved_gravity, candidate
            far = gain > FAR_GAIN
            integrated = factors if far else self._integrated_again(knots, factors)
            if integrated is not factors:
                factors, decrease = integrated, np.inf
                system = self._evaluate(knots, gravity, factors)
            factor = factorise(system)
            if decrease < COST_TOLERANCE:
                break
        found = system.squared_distances, system.weights, system.linearised, self.knot_index, system.cost
        return InertialSolution(knots, gravity, factor, *found, iterations, factors)

    def _evaluate(
        self, knots: InertialStates, gravity: Gravity, factors: InertialFactors
    ) -> InertialEquations:
        return assemble_inertial(
            self.observations,
            self.knot_index,
            knots,
            self.kinematics,
            gravity,
            factors,
            self.anchor,
            rejectable=self.rejectable,
        )

    def _along(
        self,
        knots: InertialStates,
        gravity: Gravity,
        factors: InertialFactors,
        step: FloatArray,
        shared: FloatArray,
        fractions: tuple[float, ...],
        cost: float,
        gain: float,
    ) -> tuple[InertialStates, Gravity, bool] | None:
        """Return the point at the first fraction of a step that reduces the cost enough, and whether it is not the whole step."""
        count = len(knots)
        together = max(MAX_KNOTS_TOGETHER // count, 1)
        for begin in range(0, len(fractions), together):
            some = fractions[begin : begin + together]
            error = np.concatenate([fraction * step for fraction in some])
            moved = knots.select(np.tile(np.arange(count), len(some))).retract(error)
            gravities = [gravity.retract(fraction * shared) for fraction in some]
            costs = inertial_costs(
                self.observations,
                self.knot_index,
                moved,
                gravities,
                self.kinematics,
                factors,
                self.anchor,
                rejectable=self.rejectable,
            )
            enough = np.flatnonzero(costs < cost - 0.1 * gain * np.array(some))
            if len(enough):
                row = int(enough[0])
                point = moved.select(slice(row * count, (row + 1) * count))
                return point, gravities[row], some[row] < 1.0
        return None

    def _integrated_again(self, knots: InertialStates, factors: InertialFactors) -> InertialFactors:
        """Integrate about the present biases if they have moved too far for the correction to first order."""
        if len(factors) == 0:
            return factors
        found = factors.preintegrated
        moved = knots.gyro_bias[:-1] - found.gyro_bias
        if not (np.sqrt(dot(moved, moved)) * found.duration_s > MAX_BIAS_ROTATION_RAD).any():
            return factors
        again = self.setup.factors(knots)
        if factors.odometry is not None and again.odometry is not None:
            odometry = replace(again.odometry, slip_noise=factors.odometry.slip_noise)
            return replace(again, odometry=odometry)
        return again


def factorise(system: InertialEquations) -> BorderedCholesky:
    """Factorise the normal equations. Raises GeometryError: they are not positive definite."""
    return factorise_bordered(system.diagonal, system.off_diagonal, system.border, system.corner)


def apply_linear_step(
    system: InertialEquations, knot_index: NDArray[np.intp], step: FloatArray, gain: float
) -> InertialEquations:
    """Apply a small step to residuals, weights and cost; Jacobians stay those before the step."""
    size = system.whitened.shape[2] - 1
    residuals = (
        system.whitened[:, :, size] + (system.whitened[:, :, :size] @ step[knot_index][:, :, None])[:, :, 0]
    )
    squared_distances = dot(residuals, residuals)
    # As in factors.assemble_inertial: of the motion from the knot to the measurement, a step changes next to nothing.
    moved = step[knot_index][:, :9, None]
    linearised = system.linearised
    residuals_m = linearised.residuals_m + (linearised.jacobian[:, :, :9] @ moved)[:, :, 0]
    return system._replace(
        linearised=replace(linearised, residuals_m=residuals_m),
        squared_distances=squared_distances,
        weights=(system.weights > 0) / np.maximum(squared_distances / OUTLIER_THRESHOLD**2, 1.0),
        cost=system.cost - gain,
    )
