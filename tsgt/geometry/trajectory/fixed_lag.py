"""The estimator ``continuous`` while measurements come in: a window of knots that moves along with time. Pure.

Problem: the trajectory of hours must be known now, at the same cost for each measurement. Idea: keep the knots of the
last few seconds; what came before is one Gaussian on the oldest of them, left over when the older ones are eliminated
(the Schur complement). Within the window a measurement counts whenever it comes, and all are linearised again where the
trajectory now is. docs/explanation/continuous-trajectory.md says more.

A new measurement may lie far from what was predicted because the robot did the unexpected, or because it is wrong; so what
it first counts is judged by its distance in sigmas of the prediction, not in those of the instrument.
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
    add_rows,
    assemble,
    diffuse_prior,
    knot_times,
    nearest_knots,
    nudged,
    solve,
)
from tsgt.geometry.trajectory.initialisation import initial_guess
from tsgt.geometry.trajectory.innovation_monitor import InnovationMonitor
from tsgt.geometry.trajectory.measurement_factors import Observations
from tsgt.geometry.trajectory.propagation import Propagator, acceleration_response
from tsgt.geometry.trajectory.query import Trajectory
from tsgt.geometry.trajectory.states import STATE_DIM, ProcessFactors, States, concatenate_states

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import MotionPrior

SURE_RAD = 0.1
"""One sigma of the rotation: known so well, the robot is followed from one measurement to the next."""

LOST_RAD = 0.2
"""One sigma of the rotation: not known so well any more, it has to be guessed anew. What two prisms do not tell of it is
another axis for each attitude: following further than linearisation holds would make knowledge of none."""

SOME_FIT = 0.5
NEARLY_ALL_FIT = 0.9
"""Share of the measurements that are no outliers. A trajectory that is followed bears a station on the wrong prism; one that
is found from nothing bears next to none, as with some left out another robot, metres away, may fit the rest."""

COST_TOLERANCE = 0.01
"""In squared sigmas of the whole window: a step that is to gain less is the last one. Beside an outlier, whose say changes
with each step, one of less than 1 left predictions up to 0.6 sigmas from those of a full search."""

LITTLE_M = 0.05
LITTLE_RAD = 0.005
"""All states moved by less, derivatives stay what they are: at 20 m the line of sight bends by 0.06 mm over the one, and a
prism 1.5 m away is 0.02 mm off the tangent of the other. The next measurement is linearised where the trajectory then is.
With twice as much, predictions of a robot that turns by a rad per second were up to 0.4 sigmas from those of a full search."""

BEGINNING_ITERATIONS = 10
"""Those that settle take six at most. What does not (a station on another robot) is tried again with each measurement."""

TELLING, GAP_S = 3, 1.25
"""So many measurements of each prism, none longer after the one before, tell which way a robot lies without any from before."""

LIVELIER_AHEAD = 2.0
"""How much livelier, in the variance of its accelerations, a robot is taken to be where nothing was measured yet. Driving is
not Gaussian: for minutes nothing happens, and then the robot speeds up and turns the other way at once."""

SURPRISED = 4.0
"""So far was the newest measurement from its prediction, squared and in its sigmas, from which on predictions are taken to be
as much worse: who has begun to turn goes on with that. Of robots as the prior has them it is so once in four times."""

MAX_STEPS = 5
"""Where these do not settle it, every step is tried before it is taken, as in :func:`tsgt.geometry.trajectory.gauss_newton.solve`."""

_AS_GOOD_AS_NOTHING = np.repeat([1.0, 1.0, 10.0, 10.0, 10.0, 10.0], 3)
"""One sigma of the first state once measurements tell it to millimetres: m, rad, and these per second once and twice.
With less still, rounding would lose it beside the stiff steps between knots when it is eliminated."""


class FixedLagSmoother:
    """Follows a robot.

    Parameters
    ----------
    prior
        How it moves.

    Attributes
    ----------
    observations
        The measurements of the window, in the order of time; None before the first one.
    residuals_m
        (M, 3) what each of them is off the trajectory by, as :class:`~tsgt.geometry.trajectory.measurement_factors.LinearisedMeasurements` has it;
        NaN while there is none.
    """

    def __init__(self, prior: MotionPrior) -> None:
        self._prior = prior
        self._horizon_s = -np.inf
        self._knots: States | None = None
        self._steps: ProcessFactors | None = None
        self._anchor: AnchorPrior | None = None
        self._converged = False
        self._monitor = InnovationMonitor()
        self._reliable_from_s = np.inf
        self._solved: tuple[States, BlockCholesky] | None = None
        self._trajectory: Trajectory | None = None
        self._end: Propagator | None = None
        self._innovation = 0.0
        self.observations: Observations | None = None
        self.residuals_m: FloatArray = np.empty((0, 3))

    @property
    def horizon_s(self) -> float:
        """Measurements made before this are too late: what they would have changed is no longer in the window."""
        return self._horizon_s

    @property
    def initialised(self) -> bool:
        """Whether there is a trajectory."""
        return self._solved is not None

    @property
    def converged(self) -> bool:
        """Whether it can be believed: it is known well enough, and explains what was measured."""
        return self._converged

    @property
    def reliable_from_s(self) -> float:
        """From when on a trajectory that was found anew can be believed, infinite before the first one.

        Where each prism was seen once or twice, the robot may lie the other way about the line through two of them and move
        otherwise. What comes later tells that for what comes later, not for what was before a gap. And the first measurement
        of a prism, which nothing before it contradicts, may be of a wrong one: the robot would just seem to have come from
        there. So it is the instant at which each of three prisms has been seen a second time.
        """
        return self._reliable_from_s

    @property
    def ambiguous(self) -> bool:
        """Whether the last measurements contradict each other or what was before: it is not known where the robot goes."""
        return bool(self._monitor.prisms)

    @property
    def ambiguous_from_s(self) -> float:
        """From when on it is not known where the robot was, infinite while nothing is doubtful."""
        return self._monitor.from_s

    def ambiguous_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether it will never be known where the robot was at some instants, (N,) in s; see :class:`InnovationMonitor`."""
        return self._monitor.ambiguous_at(time_s)

    def update(self, new: Observations) -> None:
        """Take measurements, in the order of time, none before :attr:`horizon_s`."""
        held, self.observations = self.observations, _merged(self.observations, new)
        try:
            if not self._converged or held is None or not self._followed(held, new):
                self._begin(self.observations)
        except GeometryError:  # not determined, or not yet
            self._converged, self._knots, self._steps, self._solved = False, None, None, None
            self.residuals_m = np.full((len(self.observations), 3), np.nan)
            self._monitor.begin(self.observations)

    def marginalise_before(self, before_s: float) -> None:
        """Let go of what was before an instant; states from then on can still be asked for, and no others."""
        self._monitor.discard_before(before_s)
        if self.observations is None:
            return
        if self._converged:
            try:
                self._marginalise(before_s)
            except GeometryError:  # by rounding alone; what the window holds is enough to begin with
                self._converged = False
        if not self._converged:
            self._horizon_s = max(self._horizon_s, before_s)
            self._keep(self.observations.time_s >= before_s)

    def _marginalise(self, before_s: float) -> None:
        """Leave of the past one Gaussian on the last knot that is not after an instant."""
        assert self.observations is not None  # noqa: S101 (it is settled)
        assert self._knots is not None  # noqa: S101 (it is settled)
        assert self._steps is not None  # noqa: S101 (it is settled)
        assert self._anchor is not None  # noqa: S101 (it is settled)
        first = int(np.searchsorted(self._knots.time_s, before_s, side="right")) - 1
        if first <= 0:
            return
        at = nearest_knots(self._knots.time_s, self.observations.time_s)
        past, knots = at < first, self._knots.select(slice(first + 1))
        steps = self._steps.select(slice(first))
        rejectable = np.ones(int(past.sum()), np.bool_)
        system = assemble(
            self.observations.select(past), at[past], knots, steps, self._anchor, rejectable=rejectable
        )
        factor = factorise(system.diagonal, system.off_diagonal)
        left = factor.last()
        expected = factor.solve(-system.gradient)[first]
        self._anchor = AnchorPrior(knots.select(slice(first, None)), left @ left.T, expected)
        self._knots, self._steps = (
            self._knots.select(slice(first, None)),
            self._steps.select(slice(first, None)),
        )
        self._horizon_s = float(self._knots.time_s[0])
        self._keep(~past)

    def predict(self, time_s: float, *, dim: int = STATE_DIM) -> tuple[States, FloatArray]:
        """Return the state at an instant, with its covariance as :meth:`Trajectory.at` does, by all measurements so far.

        Beyond the last of them the covariance is that of a livelier robot, and as much larger as the last one was farther off.
        """
        assert self._end is not None  # noqa: S101 (only called while following)
        if time_s >= self._end.time_s:
            state, covariance = self._end.at(time_s, dim=dim)
            return state, covariance * max(1.0, self._innovation / SURPRISED)
        return self.trajectory().at(np.array([time_s]), dim=dim)

    def trajectory(self) -> Trajectory:
        """Return the trajectory over the window, and over what the last :meth:`forget` let go of."""
        assert self._solved is not None  # noqa: S101 (only called while following)
        if self._trajectory is None:
            knots, factor = self._solved
            self._trajectory = Trajectory(knots, self._prior, *factor.marginals())
        return self._trajectory

    def _keep(self, rows: NDArray[np.bool_]) -> None:
        assert self.observations is not None  # noqa: S101 (only called with some)
        self.observations = self.observations.select(rows)
        self.residuals_m = self.residuals_m[rows]
        self._monitor.keep(rows)

    def _begin(self, observations: Observations) -> None:
        """Find the trajectory of all measurements of the window, knowing nothing else."""
        self._converged, self._innovation = False, 0.0
        self._monitor.begin(observations)
        if np.count_nonzero(np.bincount(observations.prism) >= 2) < 3:
            raise GeometryError("to begin with, three prisms have to be measured twice")
        guess = initial_guess(observations, knot_times(observations.time_s))
        self._anchor = diffuse_prior(guess.select(slice(0, 1)), self._prior)
        outlying = self._search(guess, BEGINNING_ITERATIONS)
        if self._converged:
            assert self._knots is not None  # noqa: S101 (it is settled)
            self._anchor = AnchorPrior(self._knots.select(slice(0, 1)), np.diag(_AS_GOOD_AS_NOTHING**-2.0))
            self._monitor.begun(float(observations.time_s[-1]))
            self._reliable_from_s = _reliable_since_s(observations.select(~outlying))

    def _followed(self, held: Observations, new: Observations) -> bool:
        """Add measurements to the trajectory found before; return whether that is still good to follow."""
        assert self.observations is not None  # noqa: S101 (that has been set)
        assert self._knots is not None  # noqa: S101 (it is settled)
        assert self._steps is not None  # noqa: S101 (it is settled)
        assert self._anchor is not None  # noqa: S101 (it is settled)
        # Compared as where knots are added: rounding must not find it near here and far there.
        if self._knots.time_s[0] - new.time_s[0] > 0.5 * MIN_KNOT_SPACING_S:
            return False  # in the first window, before anything that had come
        knots = _with_knots_at(self._knots, new.time_s, self._prior)
        steps = self._steps if knots is self._knots else ProcessFactors.of(knots.time_s, self._prior)
        at = nearest_knots(knots.time_s, self.observations.time_s)
        is_new = _order(held, new) >= len(held)
        system = assemble(
            self.observations, at, knots, steps, self._anchor, active=~is_new, rejectable=~is_new
        )
        squared_distances, in_turn = _distances_of_new(system, at, np.flatnonzero(is_new))
        weights = 1.0 / np.maximum(squared_distances / OUTLIER_THRESHOLD**2, 1.0)
        # What is hopelessly off says nothing of how the robot moves, and no other more than an outlier does.
        surprises = [
            min(each, OUTLIER_THRESHOLD**2) for each in in_turn.tolist() if each < REJECTION_THRESHOLD**2
        ]
        self._innovation = (surprises or [self._innovation])[-1]
        add_rows(system.rows[is_new], weights, at[is_new], system.diagonal, system.gradient)
        for _ in range(MAX_STEPS):
            factor = factorise(system.diagonal, system.off_diagonal)
            move = factor.solve(-system.gradient)
            gain = -float(np.vdot(move, system.gradient))
            knots = knots.retract(move)
            if gain < COST_TOLERANCE or (np.all(weights == 1.0) and _is_little(move)):
                outlying = self._take(knots, steps, factor, nudged(system, at, move))
                break
            system = assemble(self.observations, at, knots, steps, self._anchor, rejectable=~is_new)
        else:
            outlying = self._search(knots, MAX_ITERATIONS)
        self._monitor.hear(self.observations, is_new, in_turn > OUTLIER_THRESHOLD**2, outlying)
        return self._converged

    def _search(self, guess: States, max_iterations: int) -> NDArray[np.bool_]:
        """Find the trajectory however far it is from a guess; return which measurements are outliers."""
        assert self.observations is not None  # noqa: S101 (only called with some)
        found = solve(
            self.observations, guess, self._prior, anchor=self._anchor, max_iterations=max_iterations
        )
        outlying = self._take(found.knots, found.steps, found.factor, found)
        self._converged &= found.iterations < max_iterations
        return outlying

    def _take(
        self, knots: States, steps: ProcessFactors, factor: BlockCholesky, found: NormalEquations | Solution
    ) -> NDArray[np.bool_]:
        """Make it the trajectory; return which measurements are outliers."""
        self._knots, self._steps, self._solved, self._trajectory = knots, steps, (knots, factor), None
        self.residuals_m = found.linearised.residuals_m
        inverse = np.linalg.inv(factor.last())
        covariance = inverse.T @ inverse
        self._end = Propagator(
            knots.select(slice(-1, None)), covariance, self._prior, process_noise_scale=LIVELIER_AHEAD
        )
        sigma_rad = float(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1]))
        outlying: NDArray[np.bool_] = found.squared_distances >= OUTLIER_THRESHOLD**2
        fits = float(np.mean(~outlying)) > (SOME_FIT if self._converged else NEARLY_ALL_FIT)
        self._converged = fits and sigma_rad < (LOST_RAD if self._converged else SURE_RAD)
        return outlying


def _reliable_since_s(observations: Observations) -> float:
    """From when on measurements tell the trajectory by themselves; when the last one was made if they do not."""
    since_gap = [
        each_s[np.flatnonzero(np.diff(each_s, prepend=-np.inf) > GAP_S)[-1] :]
        for prism in np.unique(observations.prism)
        for each_s in [observations.time_s[observations.prism == prism]]
    ]
    counts = np.bincount(observations.prism[observations.time_s >= max(each_s[0] for each_s in since_gap)])
    if np.count_nonzero(counts >= TELLING) < 3:
        return float(observations.time_s[-1])
    return float(max(each_s[:2][-1] for each_s in since_gap))


def _distances_of_new(
    system: NormalEquations, at: NDArray[np.intp], new: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Tell how far new measurements, rows that have no say in a system, are from the others' trajectory: squared sigmas.

    Once each by itself, and once as if they came one by one: by what those before it say as well that are no outliers.
    """
    rows = system.rows[new]
    right = np.zeros((*system.gradient.shape, 3 * len(new) + 1))
    right[:, :, -1] = -system.gradient
    for place, row in enumerate(new):
        right[at[row], :, 3 * place : 3 * place + 3] = rows[place, :, :STATE_DIM].T
    found = factorise(system.diagonal, system.off_diagonal).solve(right)
    seen = rows[:, :, :STATE_DIM] @ found[at[new]]
    off = rows[:, :, STATE_DIM] + seen[:, :, -1]
    expected = np.eye(3 * len(new)) + seen[:, :, :-1].reshape(3 * len(new), 3 * len(new))
    alone = np.empty(len(new))
    for place in range(len(new)):
        own = slice(3 * place, 3 * place + 3)
        alone[place] = off[place] @ np.linalg.solve(expected[own, own], off[place])
    in_turn, fitting = alone.copy(), np.flatnonzero(alone < OUTLIER_THRESHOLD**2)
    its = (3 * fitting[:, None] + np.arange(3)).ravel()
    try:
        root = np.linalg.cholesky(expected[np.ix_(its, its)])
    except np.linalg.LinAlgError:  # by rounding alone
        raise GeometryError("the measurements do not determine the trajectory") from None
    in_turn[fitting] = (np.linalg.solve(root, off[fitting].ravel()).reshape(-1, 3) ** 2).sum(axis=1)
    return alone, in_turn


def _is_little(move: FloatArray) -> bool:
    """Whether derivatives are the same after a move."""
    return bool(np.abs(move[:, :3]).max() < LITTLE_M and np.abs(move[:, 3:6]).max() < LITTLE_RAD)


def _with_knots_at(knots: States, time_s: FloatArray, prior: MotionPrior) -> States:
    """Add knots where measurements have none near; their states are what those before them predict."""
    for instant_s in time_s:
        if np.min(np.abs(knots.time_s - instant_s)) > 0.5 * MIN_KNOT_SPACING_S:
            after = int(np.searchsorted(knots.time_s, instant_s))
            added = _predicted(knots.select(slice(after - 1, after)), instant_s, prior)
            knots = concatenate_states([knots.select(slice(after)), added, knots.select(slice(after, None))])
    return knots


def _predicted(start: States, time_s: float, prior: MotionPrior) -> States:
    dt_s = time_s - float(start.time_s[0])
    slow, turning = (
        acceleration_response(dt_s, prior.acceleration_correlation_time_s),
        acceleration_response(dt_s, prior.angular_acceleration_correlation_time_s),
    )
    turn = start.angular_velocity * dt_s + start.angular_acceleration * turning[0]
    return States(
        np.array([time_s]),
        start.position + (start.velocity * dt_s + start.acceleration * slow[0]),
        start.rotation @ exp_so3(turn),
        start.velocity + start.acceleration * slow[1],
        start.angular_velocity + start.angular_acceleration * turning[1],
        start.acceleration * slow[2],
        start.angular_acceleration * turning[2],
    )


def _order(held: Observations, new: Observations) -> NDArray[np.intp]:
    """Rows of both, put one after the other, in the order of time, those of one instant in the order of the prisms."""
    keys = [(getattr(held, name), getattr(new, name)) for name in ("station", "prism", "time_s")]
    return np.lexsort([np.concatenate(pair) for pair in keys])


def _merged(held: Observations | None, new: Observations) -> Observations:
    """Put measurements together in the order of time."""
    if held is None:
        return new
    names = [field.name for field in fields(Observations) if field.name not in ("frames", "layout")]
    order = _order(held, new)
    return replace(
        held, **{name: np.concatenate([getattr(held, name), getattr(new, name)])[order] for name in names}
    )
