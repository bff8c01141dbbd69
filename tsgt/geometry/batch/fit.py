"""Batch estimation: the trajectory of a whole recording of any length. Sans-I/O.

A long recording is solved in overlapping segments, which bounds the memory for the equations; measurements half a minute
away carry no information about a state, so that the result equals that of one segment to far below the noise. The whole
takes about 95 MB per hour of 3 stations at 2.5 Hz, and 190 MB with the part of the covariance that the states share; who
asks for poses alone takes it piece by piece.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.batch.adaptive_noise import ADAPTATIONS, adapted_sigmas
from tsgt.geometry.batch.hyperparameters import (
    NOISE_FLOOR_SHARE,
    partially_occluded,
    tune,
    with_noise_floor,
)
from tsgt.geometry.batch.knots import shared_knot_times
from tsgt.geometry.batch.noise_scales import scale_noise
from tsgt.geometry.rest import (
    RestInterval,
    add_vibration,
    find_rest,
    rest_factors,
    steps_in_rest,
    with_vibration,
)
from tsgt.geometry.trajectory.gauss_newton import (
    LOOSE_GAIN_TOLERANCE,
    PREDICTED_GAIN_TOLERANCE,
    REJECTION_THRESHOLD,
    nearest_knots,
    solve,
)
from tsgt.geometry.trajectory.initialisation import PrismTracks
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.geometry.trajectory.query import Trajectory
from tsgt.geometry.trajectory.sensitivity import common_covariance, coupling, sensitivity
from tsgt.geometry.trajectory.states import concatenate_states
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.geometry.trajectory.sensitivity import SetupJacobian
    from tsgt.geometry.trajectory.states import States

KNOTS_PER_SEGMENT = 1024  # 200 s of 3 stations at 2.5 Hz: the overlaps add an eighth to the work
MAX_ADAPTED_ITERATIONS = (
    6  # From the solution before the last adaptation, which is close; two or three suffice
)
INITIAL_GAIN_PER_KNOT, ADAPTATION_GAIN_PER_KNOT, FINAL_GAIN_PER_KNOT = 3.0, 0.3, 0.05
"""As :data:`~tsgt.geometry.trajectory.gauss_newton.LOOSE_GAIN_TOLERANCE`, per knot: before the first adaptation, 1.7 sigmas, before the
last one, half a sigma, and after it, 0.2 sigmas, without blunders. Each solution relinearises; what is left after a step to other
sigmas is a thousandth of its gain. A blunder moves a few knots by many sigmas, and small steps decide whether it is rejected.
"""
OVERLAP_KNOTS = 64  # Knots on either side of a segment that are solved with it and discarded


@dataclass(frozen=True, slots=True)
class TrajectoryFit:
    """A trajectory fitted to measurements."""

    trajectory: Trajectory
    observations: Observations  # The M measurements, their noise scaled by ``noise_scales``
    noise_scales: FloatArray  # (S, 3) factors on the stated noise by station and component
    # (M, 3) trajectory minus measurement: along the line of sight, horizontally and vertically across it
    residuals_m: FloatArray
    squared_distances: FloatArray  # (M,) squared Mahalanobis distances of the residuals
    weights: FloatArray  # (M,) of the robust loss: 1, or less for an outlier
    rest: tuple[RestInterval, ...]  # Intervals in which the robot was taken to stand still

    @property
    def prior(self) -> MotionPrior:
        """Motion prior."""
        return self.trajectory.prior

    @property
    def rest_s(self) -> float:
        """Total duration of rest."""
        return sum(each.end_s - each.start_s for each in self.rest)


@dataclass(frozen=True, slots=True)
class TrajectoryPiece:
    """A piece of a trajectory, and the measurements that are attached to its knots."""

    trajectory: Trajectory  # Its own knots and, except in the last piece, the first one of the next
    knots: int  # Of its own
    residuals_m: FloatArray  # (m, 3) fields as of :class:`TrajectoryFit`
    squared_distances: FloatArray  # (m,)
    weights: FloatArray  # (m,)


class _Segment(NamedTuple):
    """Slices of knots: those that are solved together, and those of them that are kept."""

    solved: slice
    kept: slice


def fit_trajectory(
    observations: Observations,
    *,
    prior: MotionPrior | None = None,
    occluded_prior: MotionPrior | None = None,
    noise_scale: FloatArray | float | None = None,
    rest: Sequence[RestInterval] | None = None,
    setup_jacobian: SetupJacobian | None = None,
    on_progress: Callable[[float], None] | None = None,
    on_iteration: Callable[[], None] = lambda: None,
) -> TrajectoryFit:
    """Fit a trajectory.

    Raises GeometryError: fewer than three prisms were measured, or too few measurements to tune what is not given.

    Parameters
    ----------
    observations : In the order of time, with the stated noise of the instruments.
    prior : Tuned on the measurements when not given.
    occluded_prior : Process-noise floor while fewer than three prisms are observed; ``prior`` when only that is given.
    noise_scale : Factor on the stated noise, or factors by station and component, (S, 3); tuned when not given.
    rest : Intervals in which the robot stands still; found in the measurements when not given.
    setup_jacobian : Sensitivity to the set-up's errors, for the part of the covariance that all states share.
    on_progress : Called with the completed share of the work, 0 to 1.
    on_iteration : Called before each iteration of the solver, but not while tuning; what it raises ends the fit.
    """
    if prior is None or noise_scale is None:
        tuned = tune(observations, start=prior, noise_scale=noise_scale, noise_only=prior is not None)
        noise_scale = tuned.noise_scales
        if prior is None:
            prior = with_noise_floor(tuned.prior, MotionPrior(), NOISE_FLOOR_SHARE)
            occluded_prior = occluded_prior or MotionPrior()
    in_pieces = TrajectoryInPieces(
        observations,
        prior=prior,
        occluded_prior=occluded_prior,
        noise_scale=noise_scale,
        rest=rest,
        setup_jacobian=setup_jacobian,
        on_iteration=on_iteration,
    )
    return in_pieces.joined(list(in_pieces.fitted(on_progress)))


class TrajectoryInPieces:
    """The same, one piece of a few minutes at a time, which takes little memory; parameters of :func:`fit_trajectory`.

    ``observations``: with the noise that the fit uses. ``noise_scales``, ``rest``: as of :class:`TrajectoryFit`.
    """

    def __init__(
        self,
        observations: Observations,
        *,
        prior: MotionPrior,
        noise_scale: FloatArray | float,
        occluded_prior: MotionPrior | None = None,
        rest: Sequence[RestInterval] | None = None,
        setup_jacobian: SetupJacobian | None = None,
        on_iteration: Callable[[], None] = lambda: None,
    ) -> None:
        self.noise_scales = np.ones((len(observations.frames), 3)) * noise_scale
        self.rest = tuple(find_rest(observations) if rest is None else rest)
        self.observations = with_vibration(
            scale_noise(observations, self.noise_scales), self.rest, observations.sigmas_m
        )
        self._prior, self._setup_jacobian, self._on_iteration = prior, setup_jacobian, on_iteration
        self._times_s = times_s = shared_knot_times(observations.time_s)
        self._knot_index = nearest_knots(times_s, observations.time_s)
        middle_s = 0.5 * (times_s[:-1] + times_s[1:])
        occluded = partially_occluded(observations.time_s, observations.prism, middle_s)
        occluded_sigmas = axis_sigmas(with_noise_floor(prior, occluded_prior or prior))
        sigmas = np.where(occluded[:, None], occluded_sigmas, axis_sigmas(prior))
        self._sigmas, self._rest_information = rest_factors(self.rest, times_s, sigmas, observations.layout)
        self._adaptable = ~occluded & ~steps_in_rest(self.rest, times_s)
        self._segments = _segments(len(times_s))
        self._tracks = PrismTracks.of(self.observations)

    def fitted(self, on_progress: Callable[[float], None] | None = None) -> Iterator[TrajectoryPiece]:
        """Yield the pieces in the order of time. Raises GeometryError as :func:`fit_trajectory`."""
        report_progress = on_progress or (lambda _: None)
        for completed, segment in enumerate(self._segments):
            report_progress(completed / len(self._segments))
            yield self._fit(segment)
        report_progress(1.0)

    def joined(self, pieces: Sequence[TrajectoryPiece]) -> TrajectoryFit:
        """Return the whole trajectory from all of its pieces."""
        each = [piece.trajectory for piece in pieces]
        own = [slice(piece.knots) for piece in pieces]
        commons = [trajectory.common for trajectory in each if trajectory.common is not None]
        trajectory = Trajectory(
            concatenate_states([t.knots.select(rows) for t, rows in zip(each, own, strict=True)]),
            self._prior,
            np.concatenate([t.covariance[rows] for t, rows in zip(each, own, strict=True)]),
            np.concatenate([t.cross_covariance for t in each]),
            np.concatenate([t.sigmas for t in each if t.sigmas is not None]),
            None
            if not commons
            else (
                np.concatenate([of_knots[rows] for (of_knots, _), rows in zip(commons, own, strict=True)]),
                np.concatenate([of_steps for _, of_steps in commons]),
            ),
        )
        return TrajectoryFit(
            trajectory,
            self.observations,
            self.noise_scales,
            np.concatenate([piece.residuals_m for piece in pieces]),
            np.concatenate([piece.squared_distances for piece in pieces]),
            np.concatenate([piece.weights for piece in pieces]),
            self.rest,
        )

    def _fit(self, segment: _Segment) -> TrajectoryPiece:
        first, last = segment.solved.start, segment.solved.stop
        rows = slice(*np.searchsorted(self._knot_index, (first, last)))
        steps = slice(first, last - 1)
        observations = self.observations.select(rows)
        rest = None if self._rest_information is None else self._rest_information[steps]
        guess = self._tracks.guess(self._times_s[segment.solved])
        found = _solve_adapting(
            observations,
            guess,
            self._prior,
            self._sigmas[steps],
            rest,
            self._adaptable[steps],
            self._on_iteration,
        )
        solution = found.solution
        start, stop = segment.kept.start - first, segment.kept.stop - first
        # With the next knot, up to which the states of this piece are asked for. Copies, or all of the segment would be kept.
        some = slice(start, stop + 1)
        covariance = found.covariance[some].copy()
        between = slice(start, start + len(covariance) - 1)
        cross_covariance = found.cross_covariance[between].copy()
        times_s = self._times_s[first:last][some]
        add_vibration(self.rest, times_s, observations.layout, covariance, cross_covariance)
        common = None
        if self._setup_jacobian is not None:
            displaced = _displacement(solution, observations, self._setup_jacobian)
            common = common_covariance(displaced[some])
        knots, sigmas = solution.knots.select(some), found.sigmas[between]
        measured = slice(*np.searchsorted(self._knot_index[rows], (segment.kept.start, segment.kept.stop)))
        return TrajectoryPiece(
            Trajectory(knots, self._prior, covariance, cross_covariance, sigmas, common),
            stop - start,
            solution.linearised.residuals_m[measured].copy(),
            solution.squared_distances[measured].copy(),
            solution.weights[measured].copy(),
        )


class _AdaptedSolution(NamedTuple):
    """A solution, its marginals, and the acceleration sigmas that it was found with, (K - 1, 6)."""

    solution: Solution
    covariance: FloatArray
    cross_covariance: FloatArray
    sigmas: FloatArray


def _solve_adapting(
    observations: Observations,
    guess: States,
    prior: MotionPrior,
    initial_sigmas: FloatArray,
    rest: FloatArray | None,
    adaptable: NDArray[np.bool_],
    on_iteration: Callable[[], None],
) -> _AdaptedSolution:
    """Solve, and adapt the process noise to the motion; arguments as for :func:`solve` and :func:`adapted_sigmas`."""
    sigmas = initial_sigmas
    solution = solve(
        observations,
        guess,
        prior,
        sigmas=sigmas,
        rest=rest,
        gain_tolerance=INITIAL_GAIN_PER_KNOT * len(guess),
        reject_outliers=False,
        on_iteration=on_iteration,
    )
    final_tolerance = FINAL_GAIN_PER_KNOT * len(guess)
    if (solution.squared_distances > REJECTION_THRESHOLD**2).any():
        final_tolerance = PREDICTED_GAIN_TOLERANCE
        solution = solve(
            observations,
            guess,
            prior,
            sigmas=sigmas,
            rest=rest,
            gain_tolerance=LOOSE_GAIN_TOLERANCE,
            on_iteration=on_iteration,
        )
    for last in (*[False] * (ADAPTATIONS - 1), True):
        sigmas = adapted_sigmas(
            solution,
            *solution.factor.marginals(),
            sigmas=sigmas,
            initial_sigmas=initial_sigmas,
            adaptable=adaptable,
        )
        knots = solution.knots
        del solution  # Its factor would be kept beside that of the next one
        solution = solve(
            observations,
            knots,
            prior,
            sigmas=sigmas,
            rest=rest,
            max_iterations=MAX_ADAPTED_ITERATIONS,
            gain_tolerance=final_tolerance if last else ADAPTATION_GAIN_PER_KNOT * len(guess),
            on_iteration=on_iteration,
        )
    return _AdaptedSolution(solution, *solution.factor.marginals(), sigmas)


def _displacement(
    solution: Solution, observations: Observations, setup_jacobian: SetupJacobian
) -> FloatArray:
    """(K, 18, r) displacement of a segment's states by the set-up's errors."""
    by_setup = setup_jacobian(observations, solution.linearised)
    mixed = coupling(
        observations,
        solution.linearised,
        solution.weights,
        solution.knot_index,
        len(solution.knots),
        by_setup,
    )
    return sensitivity(solution.factor, mixed)


def _segments(count: int) -> list[_Segment]:
    """Divide knots into segments of about equal length."""
    number = max(-(-count // KNOTS_PER_SEGMENT), 1)
    ends = [round(i * count / number) for i in range(number + 1)]
    return [
        _Segment(slice(max(start - OVERLAP_KNOTS, 0), min(stop + OVERLAP_KNOTS, count)), slice(start, stop))
        for start, stop in pairwise(ends)
    ]
