"""Fixed-lag smoother: the estimator ``continuous`` online, in a window of knots that moves with time. Sans-I/O.

Knots older than a few seconds are marginalised (Schur complement) into an anchor prior on the oldest knot of the window. A
new measurement's initial weight follows from its normalised innovation squared (NIS; Bar-Shalom), with the prediction's
uncertainty: a large residual may also be a manoeuvre. See docs/explanation/continuous-trajectory.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.rigid import exp_so3
from tsgt.geometry.trajectory.block_tridiagonal import BlockCholesky, factorise
from tsgt.geometry.trajectory.gauss_newton import (
    MAX_ITERATIONS,
    MIN_KNOT_SPACING_S,
    AnchorPrior,
    NormalEquations,
    Solution,
    add_measurements,
    apply_linear_step,
    assemble,
    diffuse_prior,
    knot_times,
    nearest_knots,
    solve,
)
from tsgt.geometry.trajectory.initialisation import initial_guess
from tsgt.geometry.trajectory.innovation_monitor import InnovationMonitor
from tsgt.geometry.trajectory.measurement_factors import time_order
from tsgt.geometry.trajectory.measurement_window import (
    COST_TOLERANCE,
    MAX_STEPS,
    MIN_INITIAL_INLIER_SHARE,
    MeasurementWindow,
    is_below_step_tolerance,
    normalised_innovations,
)
from tsgt.geometry.trajectory.prediction_errors import PredictionErrorMonitor
from tsgt.geometry.trajectory.propagation import Propagator, acceleration_response
from tsgt.geometry.trajectory.query import Trajectory
from tsgt.geometry.trajectory.rest_window import RestWindow
from tsgt.geometry.trajectory.sensitivity import WindowSensitivity, common_covariance
from tsgt.geometry.trajectory.states import STATE_DIM, ProcessFactors, States, concatenate_states
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.geometry.trajectory.sensitivity import SetupJacobian
    from tsgt.model import MotionPrior

MAX_INITIAL_ITERATIONS = 10  # Six at most if it converges; others are retried
MAX_FAILED_SEARCHES, RETRY_S, BRIEF_ITERATIONS = 10, 1.0, 2
"""After so many initialisations in succession that explain too few of the measurements, they are searched at this interval, and with so few
iterations in between: a search takes as long as twenty updates, and with a station that was carried away all fail.
"""

MIN_MEASUREMENTS_PER_PRISM, MAX_GAP_S = 3, 1.25  # Determine the trajectory without earlier ones
MAX_AGE_S = 1.0  # Prisms measured since then: errors of predictions are comparable
PREDICTION_NOISE_SCALE = 2.0  # After minutes of steady motion a sudden manoeuvre may come
_DIFFUSE_SIGMAS = np.repeat([1.0, 1.0, 10.0, 10.0, 10.0, 10.0], 3)
"""Sigmas of the first state's error (m, rad, and their first and second time derivatives) once measurements determine it to
millimetres. Larger ones would be lost to rounding against the stiff process factors when it is eliminated.
"""


class Predictions(NamedTuple):
    """States at N times, predicted from measurements before, or between them."""

    states: States
    covariance: FloatArray  # (N, dim, dim) of the leading components of their errors
    by_prior: FloatArray  # The same without the scales that follow from earlier errors
    comparable: list[bool]  # Whether the error of each will count for later predictions


class FixedLagSmoother(MeasurementWindow):
    """Estimates the trajectory of a robot online, from the measurements of the window and the motion prior.

    ``reliable_from_s``: each of three prisms must have been measured twice; after one or two measurements of each, the robot
    may lie the other way about the line through two prisms, which later measurements do not resolve for times before a gap; and
    the first measurement, with nothing to contradict it, may be of a wrong prism. ``revision``: while it stays the same, so do
    all states and predictions.
    """

    def __init__(self, prior: MotionPrior, setup_jacobian: SetupJacobian | None = None) -> None:
        super().__init__(InnovationMonitor())
        self._prior = prior
        self._common = None if setup_jacobian is None else WindowSensitivity(setup_jacobian)
        self._knots: States | None = None
        self._process: ProcessFactors | None = None
        self._anchor: AnchorPrior | None = None
        self._solved: tuple[States, BlockCholesky] | None = None
        self._trajectory: Trajectory | None = None
        self._rest = RestWindow(prior)
        self._smoothed: Trajectory | None = None
        self._propagator: Propagator | None = None
        self._prediction_errors = PredictionErrorMonitor()
        self._failed_searches, self._searched_s = 0, -np.inf
        self.revision = 0

    @property
    def initialised(self) -> bool:
        """Whether there is a trajectory."""
        return self._solved is not None

    def update(self, new: Observations) -> None:
        """Process measurements, in the order of time, none before :attr:`horizon_s`."""
        self._rest.add(new)
        self.revision += 1
        self._smoothed = None
        super().update(new)

    def marginalise_before(self, before_s: float) -> None:
        """Marginalise the states before a time; states from then on can still be queried."""
        self.revision += 1
        self._smoothed = None
        if self.observations is not None:
            if self._converged:
                # Before the trajectory was reliable, or while it is not, its errors are not those of the ground.
                self._prediction_errors.discard_before(min(self._reliable_from_s, before_s))
                self._prediction_errors.compare_before(
                    min(before_s, self.ambiguous_from_s), self.trajectory()
                )
            self._prediction_errors.discard_before(before_s)
        super().marginalise_before(before_s)

    def _discard_trajectory(self) -> None:
        self._knots, self._process, self._solved = None, None, None

    @property
    def _window(self) -> tuple[Observations, States, ProcessFactors, AnchorPrior]:
        """Measurements, knots, process factors and anchor prior; only while converged."""
        assert self.observations is not None  # noqa: S101 (converged)
        assert self._knots is not None  # noqa: S101 (converged)
        assert self._process is not None  # noqa: S101 (converged)
        assert self._anchor is not None  # noqa: S101 (converged)
        return self.observations, self._knots, self._process, self._anchor

    def _eliminate_before(self, before_s: float) -> None:
        observations, knots, process, anchor = self._window
        first = int(np.searchsorted(knots.time_s, before_s, side="right")) - 1
        if first <= 0:
            return
        knot_index = nearest_knots(knots.time_s, observations.time_s)
        is_past = knot_index < first
        system = assemble(
            observations.select(is_past),
            knot_index[is_past],
            knots.select(slice(first + 1)),
            process.select(slice(first)),
            anchor,
            rejectable=np.ones(int(is_past.sum()), np.bool_),
        )
        factor = factorise(system.diagonal, system.off_diagonal)
        root = factor.last_block()
        mean = factor.solve(-system.gradient)[first]
        if self._common is not None:
            past = observations.select(is_past)
            self._common.marginalise(
                past, system.linearised, system.weights, knot_index[is_past], anchor, factor
            )
        self._anchor = AnchorPrior(knots.select(slice(first, first + 1)), root @ root.T, mean)
        self._knots, self._process = knots.select(slice(first, None)), process.select(slice(first, None))
        self._horizon_s = float(self._knots.time_s[0])
        self._select(~is_past)

    def predict(self, time_s: float, *, dim: int = STATE_DIM) -> tuple[States, FloatArray]:
        """Return the state at a time, given all measurements so far, with its covariance as :meth:`Trajectory.at` does.

        See :meth:`predictions`; its error counts for later ones.
        """
        found = self.predictions(np.array([time_s]), dim=dim)
        self.record(found, 0)
        return found.states, found.covariance

    def predictions(self, time_s: FloatArray, *, dim: int = STATE_DIM) -> Predictions:
        """Return states at N times in their order, given all measurements so far.

        Beyond the last measurement :data:`PREDICTION_NOISE_SCALE` scales the process noise, the newest NIS the covariance
        and, while three prisms are observed, the errors of earlier predictions that of each axis.
        """
        assert self._propagator is not None  # noqa: S101 (only called while initialised)
        inside = int(time_s.searchsorted(self._propagator.time_s))
        if inside:
            states, covariance = self.trajectory().at(time_s[:inside], dim=dim)
            found = Predictions(states, covariance, covariance, [False] * inside)
            if inside == len(time_s):
                return found
            beyond = self.predictions(time_s[inside:], dim=dim)
            return Predictions(
                concatenate_states([states, beyond.states]),
                np.concatenate([covariance, beyond.covariance]),
                np.concatenate([covariance, beyond.by_prior]),
                [*found.comparable, *beyond.comparable],
            )
        states, by_prior = self._propagator.at_times(time_s, dim=dim)
        tracked = self._converged and not self.ambiguous
        comparable = [tracked and self._observed_prisms(each_s) >= MIN_PRISMS for each_s in time_s.tolist()]
        covariance = by_prior
        if any(comparable):
            scaled = self._prediction_errors.scaled(by_prior)
            covariance = (
                scaled if all(comparable) else np.where(np.array(comparable)[:, None, None], scaled, by_prior)
            )
        return Predictions(states, covariance * self._prediction_scale(), by_prior, comparable)

    def record(self, predictions: Predictions, row: int) -> None:
        """Compare a prediction with the trajectory later: its error counts for later predictions."""
        if predictions.comparable[row]:
            only = slice(row, row + 1)
            self._prediction_errors.record(predictions.states.select(only), predictions.by_prior[only])

    def _observed_prisms(self, time_s: float) -> int:
        """Count the prisms measured shortly before a time."""
        assert self.observations is not None  # noqa: S101 (converged)
        return len(set(self.observations.prism[self.observations.time_s >= time_s - MAX_AGE_S].tolist()))

    def trajectory(self) -> Trajectory:
        """Return the trajectory over the window and over what the last :meth:`marginalise_before` eliminated."""
        assert self._solved is not None  # noqa: S101 (only called while initialised)
        if self._trajectory is None:
            knots, factor = self._solved
            self._trajectory = Trajectory(
                knots,
                self._prior,
                *factor.marginals(),
                common=None
                if self._common is None
                else common_covariance(self._common.of_window(knots, factor)),
            )
        return self._trajectory

    def smoothed_trajectory(self) -> Trajectory:
        """Return the trajectory for states between measurements, with rest as far as the window shows it."""
        if self._smoothed is None:
            self._smoothed = self._with_rest() or self.trajectory()
        return self._smoothed

    def _with_rest(self) -> Trajectory | None:
        if not self._converged:
            return None
        observations, knots, _, anchor = self._window
        try:
            return self._rest.solve(observations, knots, anchor, self._common)
        except GeometryError:  # by rounding alone
            return None

    def common_at(self, time_s: float, *, dim: int = STATE_DIM) -> FloatArray | None:
        """Return the (1, dim, dim) covariance that the set-up's uncertainty adds to :meth:`predict`; None: unknown."""
        return self.predictions_common(np.array([time_s]), dim=dim)

    def predictions_common(self, time_s: FloatArray, *, dim: int = STATE_DIM) -> FloatArray | None:
        """Return the (N, dim, dim) covariance that the set-up's uncertainty adds to :meth:`predictions`; None: unknown."""
        if self._common is None:
            return None
        assert self._solved is not None  # noqa: S101 (only called while initialised)
        assert self._propagator is not None  # noqa: S101 (only called while initialised)
        inside = int(time_s.searchsorted(self._propagator.time_s))
        parts = [self.trajectory().common_at(time_s[:inside], dim=dim)] if inside else []
        if inside < len(time_s):
            newest = self._common.of_window(*self._solved)[-1]
            displacement = self._propagator.by_start_at_times(time_s[inside:])[:, :dim] @ newest
            parts.append(displacement @ displacement.swapaxes(1, 2))
        return np.concatenate([each for each in parts if each is not None])

    def _initialise(self, observations: Observations) -> None:
        self._converged, self._newest_nis = False, 0.0
        self._monitor.reset(observations)
        if np.count_nonzero(np.bincount(observations.prism) >= 2) < 3:
            raise GeometryError("an initialisation needs two measurements of each of three prisms")
        guess = initial_guess(observations, knot_times(observations.time_s))
        self._anchor = diffuse_prior(guess.select(slice(0, 1)), self._prior)
        if self._common is not None:
            self._common.reset()
        newest_s = float(observations.time_s[-1])
        brief = self._failed_searches >= MAX_FAILED_SEARCHES and newest_s < self._searched_s + RETRY_S
        outliers = self._solve(guess, BRIEF_ITERATIONS if brief else MAX_INITIAL_ITERATIONS)
        if not brief:
            inconsistent = float(np.mean(outliers)) >= 1.0 - MIN_INITIAL_INLIER_SHARE
            self._failed_searches = self._failed_searches + 1 if inconsistent else 0
            self._searched_s = newest_s
        if self._converged:
            assert self._knots is not None  # noqa: S101 (converged)
            self._anchor = AnchorPrior(self._knots.select(slice(0, 1)), np.diag(_DIFFUSE_SIGMAS**-2.0))
            self._monitor.set_start(float(observations.time_s[-1]))
            self._reliable_from_s = _determined_from_s(observations.select(~outliers))

    def _update_tracked(self, held: Observations, new: Observations) -> bool:
        observations, knots, process, anchor = self._window
        # The same comparison as in _insert_knots: rounding must not decide differently.
        if knots.time_s[0] - new.time_s[0] > 0.5 * MIN_KNOT_SPACING_S:
            return False  # in the first window, earlier than all others
        knots, process = _insert_knots(knots, process, new.time_s, self._prior)
        knot_index = nearest_knots(knots.time_s, observations.time_s)
        is_new = time_order(held, new) >= len(held)
        system = assemble(
            observations, knot_index, knots, process, anchor, active=~is_new, rejectable=~is_new
        )
        factor = factorise(system.diagonal, system.off_diagonal)
        nis, sequential_nis = normalised_innovations(
            system.whitened[is_new], knot_index[is_new], system.gradient, factor.solve
        )
        weights = self._weigh(nis, sequential_nis)
        system.weights[is_new] = weights
        last = system.diagonal[-1].copy()
        add_measurements(
            system.whitened[is_new], weights, knot_index[is_new], system.diagonal, system.gradient
        )
        if (knot_index[is_new] == len(knots) - 1).all():
            factor = factor.with_last_block_added(system.diagonal[-1] - last)
        else:
            factor = factorise(system.diagonal, system.off_diagonal)
        for _ in range(MAX_STEPS):
            step = factor.solve(-system.gradient)
            gain = -float(np.vdot(step, system.gradient))
            knots = knots.retract(step)
            if gain < COST_TOLERANCE or (np.all(weights == 1.0) and is_below_step_tolerance(step)):
                outliers = self._accept(knots, process, factor, apply_linear_step(system, knot_index, step))
                break
            system = assemble(observations, knot_index, knots, process, anchor, rejectable=~is_new)
            factor = factorise(system.diagonal, system.off_diagonal)
        else:
            outliers = self._solve(knots, MAX_ITERATIONS)
        self._monitor.update(observations, is_new, sequential_nis, outliers, self.residuals_m)
        return self._converged

    def _solve(self, guess: States, max_iterations: int) -> NDArray[np.bool_]:
        """Search for the trajectory from a guess however far off; return which measurements are outliers."""
        assert self.observations is not None  # noqa: S101 (only called with some)
        found = solve(
            self.observations, guess, self._prior, anchor=self._anchor, max_iterations=max_iterations
        )
        outliers = self._accept(found.knots, found.process, found.factor, found)
        self._converged &= found.iterations < max_iterations
        return outliers

    def _accept(
        self, knots: States, process: ProcessFactors, factor: BlockCholesky, found: NormalEquations | Solution
    ) -> NDArray[np.bool_]:
        """Make a solution the trajectory; return which measurements are outliers."""
        self._knots, self._process, self._solved, self._trajectory = knots, process, (knots, factor), None
        self.residuals_m = found.linearised.residuals_m
        if self._common is not None:
            assert self.observations is not None  # noqa: S101 (they were solved)
            assert self._anchor is not None  # noqa: S101 (it was solved with)
            self._common.record(self.observations, found.linearised, found.weights, self._anchor)
        inverse = np.linalg.inv(factor.last_block())
        covariance = inverse.T @ inverse
        self._propagator = Propagator(
            knots.select(slice(-1, None)), covariance, self._prior, process_noise_scale=PREDICTION_NOISE_SCALE
        )
        return self._check(found.squared_distances, covariance[3:6, 3:6])


def _determined_from_s(observations: Observations) -> float:
    """Time from which the measurements determine the trajectory by themselves; that of the last one if they do not."""
    since_gap = [
        each_s[np.flatnonzero(np.diff(each_s, prepend=-np.inf) > MAX_GAP_S)[-1] :]
        for prism in np.unique(observations.prism)
        for each_s in [observations.time_s[observations.prism == prism]]
    ]
    counts = np.bincount(observations.prism[observations.time_s >= max(each_s[0] for each_s in since_gap)])
    if np.count_nonzero(counts >= MIN_MEASUREMENTS_PER_PRISM) < 3:
        return float(observations.time_s[-1])
    return float(max(each_s[:2][-1] for each_s in since_gap))


def _insert_knots(
    knots: States, process: ProcessFactors, time_s: FloatArray, prior: MotionPrior
) -> tuple[States, ProcessFactors]:
    """Insert knots at measurement times that have none nearby; their states are propagated from the knot before."""
    for instant_s in time_s.tolist():
        if np.abs(knots.time_s - instant_s).min() > 0.5 * MIN_KNOT_SPACING_S:
            after = int(knots.time_s.searchsorted(instant_s))
            before, later = knots.select(slice(after)), knots.select(slice(after, None))
            added = _propagate(knots.select(slice(after - 1, after)), instant_s, prior)
            knots = concatenate_states([before, added, later] if len(later) else [before, added])
            steps = ProcessFactors.of(knots.time_s[after - 1 : after + 2], prior)
            process = ProcessFactors(
                np.concatenate([process.phi[: after - 1], steps.phi, process.phi[after:]]),
                np.concatenate(
                    [process.information[: after - 1], steps.information, process.information[after:]]
                ),
            )
    return knots, process


def _propagate(start: States, time_s: float, prior: MotionPrior) -> States:
    dt_s = time_s - float(start.time_s[0])
    linear, angular = (
        acceleration_response(dt_s, prior.acceleration_correlation_time_s),
        acceleration_response(dt_s, prior.angular_acceleration_correlation_time_s),
    )
    rotvec = start.angular_velocity * dt_s + start.angular_acceleration * angular[0]
    return States(
        np.array([time_s]),
        start.position + (start.velocity * dt_s + start.acceleration * linear[0]),
        start.rotation @ exp_so3(rotvec),
        start.velocity + start.acceleration * linear[1],
        start.angular_velocity + start.angular_acceleration * angular[1],
        start.acceleration * linear[2],
        start.angular_acceleration * angular[2],
    )
