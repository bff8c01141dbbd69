"""Fixed-lag smoother: the estimator ``continuous`` online, in a window of knots that moves with time. Sans-I/O.

Knots older than a few seconds are marginalised (Schur complement) into an anchor prior on the oldest knot of the window. A
new measurement's initial weight follows from its normalised innovation squared (NIS; Bar-Shalom), with the prediction's
uncertainty: a large residual may also be a manoeuvre. See docs/explanation/continuous-trajectory.md.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.rigid import exp_so3
from tsgt.geometry.trajectory.block_tridiagonal import BlockCholesky, factorise
from tsgt.geometry.trajectory.gauss_newton import (
    MAX_ITERATIONS,
    MIN_KNOT_SPACING_S,
    OUTLIER_THRESHOLD,
    REJECTION_THRESHOLD,
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
from tsgt.geometry.trajectory.innovation_monitor import AMBIGUITY_MARGIN_S, InnovationMonitor
from tsgt.geometry.trajectory.measurement_factors import Observations
from tsgt.geometry.trajectory.prediction_errors import PredictionErrorMonitor
from tsgt.geometry.trajectory.propagation import Propagator, acceleration_response
from tsgt.geometry.trajectory.query import Trajectory
from tsgt.geometry.trajectory.sensitivity import WindowSensitivity, common_covariance
from tsgt.geometry.trajectory.states import STATE_DIM, ProcessFactors, States, concatenate_states

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.sensitivity import SetupJacobian
    from tsgt.model import MotionPrior

CONVERGED_SIGMA_RAD = 0.1  # Below, an initialised trajectory is tracked
LOST_SIGMA_RAD = 0.2
"""Rotation sigma above which the trajectory is reinitialised. The rotation that two prisms leave unobserved is about another
axis for each attitude: tracking beyond the range of the linearisation would create information from nothing.
"""

MIN_INLIER_SHARE = 0.5
MIN_INITIAL_INLIER_SHARE = 0.9
"""Share of inliers. A tracked trajectory tolerates a station on a wrong prism, an initialisation next to none: with some
measurements rejected, another pose metres away may fit the rest.
"""

COST_TOLERANCE = 0.01
"""Predicted gain, in squared sigmas of the whole window, below which a step is the last one. With an outlier, whose weight
changes with each step, a tolerance of 1 left predictions up to 0.6 sigmas from those of a full search.
"""

STEP_TOLERANCE_M = 0.05
STEP_TOLERANCE_RAD = 0.005
"""Steps below both need no relinearisation: at 20 m the line of sight changes by 0.06 mm over the one, and a prism at
1.5 m is 0.02 mm off the tangent of the other. The next measurement relinearises. With twice as much, predictions of a
robot rotating at 1 rad/s were up to 0.4 sigmas from those of a full search.
"""

MAX_INITIAL_ITERATIONS = 10  # Six at most if it converges; others are retried
MIN_MEASUREMENTS_PER_PRISM, MAX_GAP_S = 3, 1.25  # Determine the trajectory without earlier ones
MIN_PRISMS, MAX_AGE_S = 3, 1.0  # Prisms measured since then: errors of predictions are comparable
PREDICTION_NOISE_SCALE = 2.0  # After minutes of steady motion a sudden manoeuvre may come
PREDICTION_NIS_THRESHOLD = 4.0
"""NIS of the newest measurement above which the covariance of predictions is scaled up in proportion: a manoeuvre that has
begun goes on. A robot that moves as the prior says exceeds it once in four times.
"""

MAX_STEPS = 5  # Without line search; then ``gauss_newton.solve`` takes over
_DIFFUSE_SIGMAS = np.repeat([1.0, 1.0, 10.0, 10.0, 10.0, 10.0], 3)
"""Sigmas of the first state's error (m, rad, and their first and second time derivatives) once measurements determine it to
millimetres. Larger ones would be lost to rounding against the stiff process factors when it is eliminated.
"""


class FixedLagSmoother:
    """Estimates the trajectory of a robot online, from ``observations``: those of the window in the order of time, or None.

    ``residuals_m``: (M, 3) as in :class:`~tsgt.geometry.trajectory.measurement_factors.LinearisedMeasurements`; NaN without
    a trajectory.
    """

    def __init__(self, prior: MotionPrior, setup_jacobian: SetupJacobian | None = None) -> None:
        self._prior = prior
        self._common = None if setup_jacobian is None else WindowSensitivity(setup_jacobian)
        self._horizon_s = -np.inf
        self._knots: States | None = None
        self._process: ProcessFactors | None = None
        self._anchor: AnchorPrior | None = None
        self._converged = False
        self._monitor = InnovationMonitor()
        self._reliable_from_s = np.inf
        self._solved: tuple[States, BlockCholesky] | None = None
        self._trajectory: Trajectory | None = None
        self._propagator: Propagator | None = None
        self._newest_nis = 0.0
        self._prediction_errors = PredictionErrorMonitor()
        self.observations: Observations | None = None
        self.residuals_m: FloatArray = np.empty((0, 3))

    @property
    def horizon_s(self) -> float:
        """Start of the window: earlier measurements are rejected."""
        return self._horizon_s

    @property
    def initialised(self) -> bool:
        """Whether there is a trajectory."""
        return self._solved is not None

    @property
    def converged(self) -> bool:
        """Whether the trajectory is certain enough and explains the measurements."""
        return self._converged

    @property
    def reliable_from_s(self) -> float:
        """Time from which the trajectory since the last initialisation is reliable, infinite before the first one.

        Each of three prisms must have been measured twice: after one or two measurements of each, the robot may lie the
        other way about the line through two prisms, which later measurements do not resolve for times before a gap; and the
        first measurement, with nothing to contradict it, may be of a wrong prism.
        """
        return self._reliable_from_s

    @property
    def ambiguous(self) -> bool:
        """Whether the newest measurements are inconsistent with each other or with the trajectory."""
        return bool(self._monitor.inconsistent_prisms)

    @property
    def ambiguous_from_s(self) -> float:
        """Start of the current ambiguity, infinite while the measurements are consistent."""
        return self._monitor.ambiguous_from_s

    def ambiguous_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether the state stays ambiguous at times (N,); see :class:`InnovationMonitor`."""
        return self._monitor.ambiguous_at(time_s)

    def recently_ambiguous_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether the state was ambiguous up to :data:`AMBIGUITY_MARGIN_S` before times (N,)."""
        return self._monitor.ambiguous_at(time_s, margin_s=AMBIGUITY_MARGIN_S)

    def update(self, new: Observations) -> None:
        """Process measurements, in the order of time, none before :attr:`horizon_s`."""
        held, self.observations = self.observations, _merge(self.observations, new)
        try:
            if not self._converged or held is None or not self._update_tracked(held, new):
                self._initialise(self.observations)
        except GeometryError:  # not determined, or not yet
            self._converged, self._knots, self._process, self._solved = False, None, None, None
            self.residuals_m = np.full((len(self.observations), 3), np.nan)
            self._monitor.reset(self.observations)

    def marginalise_before(self, before_s: float) -> None:
        """Marginalise the states before a time; states from then on can still be queried."""
        self._monitor.discard_before(before_s)
        if self.observations is None:
            return
        if self._converged:
            # Before the trajectory was reliable, or while it is not, its errors are not those of the ground.
            self._prediction_errors.discard_before(min(self._reliable_from_s, before_s))
            self._prediction_errors.compare_before(min(before_s, self.ambiguous_from_s), self.trajectory())
        self._prediction_errors.discard_before(before_s)
        if self._converged:
            try:
                self._eliminate_before(before_s)
            except GeometryError:  # by rounding alone; the window suffices to reinitialise
                self._converged = False
        if not self._converged:
            self._horizon_s = max(self._horizon_s, before_s)
            self._select(self.observations.time_s >= before_s)

    @property
    def _window(self) -> tuple[Observations, States, ProcessFactors, AnchorPrior]:
        """Measurements, knots, process factors and anchor prior; only while converged."""
        assert self.observations is not None  # noqa: S101 (converged)
        assert self._knots is not None  # noqa: S101 (converged)
        assert self._process is not None  # noqa: S101 (converged)
        assert self._anchor is not None  # noqa: S101 (converged)
        return self.observations, self._knots, self._process, self._anchor

    def _eliminate_before(self, before_s: float) -> None:
        """Marginalise the knots before the last one that is not after a time into an anchor prior on it."""
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

        Beyond the last measurement :data:`PREDICTION_NOISE_SCALE` scales the process noise, the newest NIS the covariance
        and, while three prisms are observed, the errors of earlier predictions that of each axis.
        """
        assert self._propagator is not None  # noqa: S101 (only called while initialised)
        if time_s >= self._propagator.time_s:
            state, covariance = self._propagator.at(time_s, dim=dim)
            if self._converged and not self.ambiguous and self._observed_prisms(time_s) >= MIN_PRISMS:
                self._prediction_errors.record(state, covariance)
                covariance = self._prediction_errors.scaled(covariance)
            return state, covariance * max(1.0, self._newest_nis / PREDICTION_NIS_THRESHOLD)
        return self.trajectory().at(np.array([time_s]), dim=dim)

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

    def common_at(self, time_s: float, *, dim: int = STATE_DIM) -> FloatArray | None:
        """Return the (1, dim, dim) covariance that the set-up's uncertainty adds to :meth:`predict`; None: unknown."""
        if self._common is None:
            return None
        assert self._solved is not None  # noqa: S101 (only called while initialised)
        assert self._propagator is not None  # noqa: S101 (only called while initialised)
        if time_s < self._propagator.time_s:
            return self.trajectory().common_at(np.array([time_s]), dim=dim)
        newest = self._common.of_window(*self._solved)[-1]
        displacement = self._propagator.by_start(time_s)[:dim] @ newest
        covariance: FloatArray = (displacement @ displacement.T)[None]
        return covariance

    def _select(self, rows: NDArray[np.bool_]) -> None:
        assert self.observations is not None  # noqa: S101 (only called with some)
        self.observations = self.observations.select(rows)
        self.residuals_m = self.residuals_m[rows]
        self._monitor.select(rows)

    def _initialise(self, observations: Observations) -> None:
        """Find the trajectory of all measurements of the window without any prior knowledge."""
        self._converged, self._newest_nis = False, 0.0
        self._monitor.reset(observations)
        if np.count_nonzero(np.bincount(observations.prism) >= 2) < 3:
            raise GeometryError("an initialisation needs two measurements of each of three prisms")
        guess = initial_guess(observations, knot_times(observations.time_s))
        self._anchor = diffuse_prior(guess.select(slice(0, 1)), self._prior)
        if self._common is not None:
            self._common.reset()
        outliers = self._solve(guess, MAX_INITIAL_ITERATIONS)
        if self._converged:
            assert self._knots is not None  # noqa: S101 (converged)
            self._anchor = AnchorPrior(self._knots.select(slice(0, 1)), np.diag(_DIFFUSE_SIGMAS**-2.0))
            self._monitor.set_start(float(observations.time_s[-1]))
            self._reliable_from_s = _determined_from_s(observations.select(~outliers))

    def _update_tracked(self, held: Observations, new: Observations) -> bool:
        """Add measurements to the trajectory and return whether it can still be tracked."""
        observations, knots, process, anchor = self._window
        # The same comparison as in _insert_knots: rounding must not decide differently.
        if knots.time_s[0] - new.time_s[0] > 0.5 * MIN_KNOT_SPACING_S:
            return False  # in the first window, earlier than all others
        knots = _insert_knots(knots, new.time_s, self._prior)
        if knots is not self._knots:
            process = ProcessFactors.of(knots.time_s, self._prior)
        knot_index = nearest_knots(knots.time_s, observations.time_s)
        is_new = _time_order(held, new) >= len(held)
        system = assemble(
            observations, knot_index, knots, process, anchor, active=~is_new, rejectable=~is_new
        )
        nis, sequential_nis = _innovations(system, knot_index, np.flatnonzero(is_new))
        weights = 1.0 / np.maximum(nis / OUTLIER_THRESHOLD**2, 1.0)
        # A rejected measurement says nothing about the motion, any other no more than an outlier.
        newest = [
            min(each, OUTLIER_THRESHOLD**2)
            for each in sequential_nis.tolist()
            if each < REJECTION_THRESHOLD**2
        ]
        self._newest_nis = (newest or [self._newest_nis])[-1]
        add_measurements(
            system.whitened[is_new], weights, knot_index[is_new], system.diagonal, system.gradient
        )
        for _ in range(MAX_STEPS):
            factor = factorise(system.diagonal, system.off_diagonal)
            step = factor.solve(-system.gradient)
            gain = -float(np.vdot(step, system.gradient))
            knots = knots.retract(step)
            if gain < COST_TOLERANCE or (np.all(weights == 1.0) and _is_below_step_tolerance(step)):
                outliers = self._accept(knots, process, factor, apply_linear_step(system, knot_index, step))
                break
            system = assemble(observations, knot_index, knots, process, anchor, rejectable=~is_new)
        else:
            outliers = self._solve(knots, MAX_ITERATIONS)
        self._monitor.update(observations, is_new, sequential_nis > OUTLIER_THRESHOLD**2, outliers)
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
        sigma_rad = float(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1]))
        outliers: NDArray[np.bool_] = found.squared_distances >= OUTLIER_THRESHOLD**2
        enough_inliers = float(np.mean(~outliers)) > (
            MIN_INLIER_SHARE if self._converged else MIN_INITIAL_INLIER_SHARE
        )
        self._converged = enough_inliers and sigma_rad < (
            LOST_SIGMA_RAD if self._converged else CONVERGED_SIGMA_RAD
        )
        return outliers


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


def _innovations(
    system: NormalEquations, knot_index: NDArray[np.intp], is_new: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """NIS of new measurements, inactive in ``system``: each one's own, and conditioned on those before it that are inliers."""
    whitened = system.whitened[is_new]
    rhs = np.zeros((*system.gradient.shape, 3 * len(is_new) + 1))
    rhs[:, :, -1] = -system.gradient
    for i, index in enumerate(is_new):
        rhs[knot_index[index], :, 3 * i : 3 * i + 3] = whitened[i, :, :STATE_DIM].T
    solved = factorise(system.diagonal, system.off_diagonal).solve(rhs)
    projected = whitened[:, :, :STATE_DIM] @ solved[knot_index[is_new]]
    innovations = whitened[:, :, STATE_DIM] + projected[:, :, -1]
    covariance = np.eye(3 * len(is_new)) + projected[:, :, :-1].reshape(3 * len(is_new), 3 * len(is_new))
    nis = np.empty(len(is_new))
    for i in range(len(is_new)):
        block = slice(3 * i, 3 * i + 3)
        nis[i] = innovations[i] @ np.linalg.solve(covariance[block, block], innovations[i])
    sequential_nis, inliers = nis.copy(), np.flatnonzero(nis < OUTLIER_THRESHOLD**2)
    components = (3 * inliers[:, None] + np.arange(3)).ravel()
    try:
        root = np.linalg.cholesky(covariance[np.ix_(components, components)])
    except np.linalg.LinAlgError:  # by rounding alone
        raise GeometryError("the measurements do not determine the trajectory") from None
    sequential_nis[inliers] = (np.linalg.solve(root, innovations[inliers].ravel()).reshape(-1, 3) ** 2).sum(
        axis=1
    )
    return nis, sequential_nis


def _is_below_step_tolerance(step: FloatArray) -> bool:
    """Whether Jacobians stay the same over a step."""
    return bool(
        np.abs(step[:, :3]).max() < STEP_TOLERANCE_M and np.abs(step[:, 3:6]).max() < STEP_TOLERANCE_RAD
    )


def _insert_knots(knots: States, time_s: FloatArray, prior: MotionPrior) -> States:
    """Insert knots at measurement times that have none nearby; their states are propagated from the knot before."""
    for instant_s in time_s:
        if np.min(np.abs(knots.time_s - instant_s)) > 0.5 * MIN_KNOT_SPACING_S:
            after = int(np.searchsorted(knots.time_s, instant_s))
            added = _propagate(knots.select(slice(after - 1, after)), instant_s, prior)
            knots = concatenate_states([knots.select(slice(after)), added, knots.select(slice(after, None))])
    return knots


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


def _time_order(held: Observations, new: Observations) -> NDArray[np.intp]:
    """Sorting index of both, concatenated, by time, then prism, then station."""
    keys = [(getattr(held, name), getattr(new, name)) for name in ("station", "prism", "time_s")]
    return np.lexsort([np.concatenate(pair) for pair in keys])


def _merge(held: Observations | None, new: Observations) -> Observations:
    """Merge measurements in the order of time."""
    if held is None:
        return new
    names = [field.name for field in fields(Observations) if field.name not in ("frames", "layout")]
    order = _time_order(held, new)
    return replace(
        held, **{name: np.concatenate([getattr(held, name), getattr(new, name)])[order] for name in names}
    )
