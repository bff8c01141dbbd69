"""Batch estimation: the trajectory of a whole recording of any length. Sans-I/O.

A long recording is solved in overlapping segments, which bounds the memory for the equations; measurements half a minute
away carry no information about a state, so that the result equals that of one segment to far below the noise. The result
takes about 140 MB per hour of 3 stations at 2.5 Hz, and 280 MB with the part of the covariance that the states share.
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
from tsgt.geometry.batch.noise_scales import scale_noise
from tsgt.geometry.rest import (
    RestInterval,
    add_vibration,
    find_rest,
    rest_factors,
    steps_in_rest,
    with_vibration,
)
from tsgt.geometry.trajectory.gauss_newton import knot_times, nearest_knots, solve
from tsgt.geometry.trajectory.initialisation import PrismTracks
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.geometry.trajectory.query import Trajectory
from tsgt.geometry.trajectory.sensitivity import common_covariance, coupling, sensitivity
from tsgt.geometry.trajectory.states import concatenate_states
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.geometry.trajectory.sensitivity import SetupJacobian
    from tsgt.geometry.trajectory.states import States

KNOTS_PER_SEGMENT = 1024  # About two minutes of 3 stations at 2.5 Hz: their blocks fit into the cache
MAX_ADAPTED_ITERATIONS = (
    6  # From the solution before the last adaptation, which is close; two or three suffice
)
OVERLAP_KNOTS = 128  # Knots on either side of a segment that are solved with it and discarded


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
    """
    report_progress = on_progress or (lambda _: None)
    if prior is None or noise_scale is None:
        tuned = tune(observations, start=prior, noise_scale=noise_scale, noise_only=prior is not None)
        noise_scale = tuned.noise_scales
        if prior is None:
            prior = with_noise_floor(tuned.prior, MotionPrior(), NOISE_FLOOR_SHARE)
            occluded_prior = occluded_prior or MotionPrior()
    scales = np.ones((len(observations.frames), 3)) * noise_scale
    rest = tuple(find_rest(observations) if rest is None else rest)
    observations = with_vibration(scale_noise(observations, scales), rest, observations.sigmas_m)
    times_s = knot_times(observations.time_s)
    knot_index = nearest_knots(times_s, observations.time_s)
    occluded = partially_occluded(observations.time_s, observations.prism, 0.5 * (times_s[:-1] + times_s[1:]))
    occluded_sigmas = axis_sigmas(with_noise_floor(prior, occluded_prior or prior))
    sigmas = np.where(occluded[:, None], occluded_sigmas, axis_sigmas(prior))
    sigmas, rest_information = rest_factors(rest, times_s, sigmas, observations.layout)
    adaptable = ~occluded & ~steps_in_rest(rest, times_s)
    segments = _segments(len(times_s))
    tracks = PrismTracks.of(observations)
    knots, covariances, cross_covariances, residuals_m, squared_distances, weights = [], [], [], [], [], []
    adapted = sigmas.copy()
    displacements: list[FloatArray] = []
    for completed, segment in enumerate(segments):
        report_progress(completed / len(segments))
        rows = slice(*np.searchsorted(knot_index, (segment.solved.start, segment.solved.stop)))
        steps = slice(segment.solved.start, segment.solved.stop - 1)
        found = _solve_adapting(
            observations.select(rows),
            tracks.guess(times_s[segment.solved]),
            prior,
            sigmas[steps],
            None if rest_information is None else rest_information[steps],
            adaptable[steps],
        )
        solution, covariance, cross_covariance = found.solution, found.covariance, found.cross_covariance
        kept_steps = slice(segment.kept.start, min(segment.kept.stop, len(adapted)))
        adapted[kept_steps] = found.sigmas[kept_steps.start - steps.start : kept_steps.stop - steps.start]
        kept_knots = slice(
            segment.kept.start - segment.solved.start, segment.kept.stop - segment.solved.start
        )
        if setup_jacobian is not None:
            displacements.append(
                _displacement(solution, observations.select(rows), setup_jacobian)[kept_knots]
            )
        knots.append(solution.knots.select(kept_knots))
        covariances.append(covariance[kept_knots])
        cross_covariances.append(cross_covariance[kept_knots])
        kept = slice(*np.searchsorted(knot_index[rows], (segment.kept.start, segment.kept.stop)))
        # Keep only these parts: the solution's factor is as large as the rest.
        residuals_m.append(solution.linearised.residuals_m[kept])
        squared_distances.append(solution.squared_distances[kept])
        weights.append(solution.weights[kept])
    report_progress(1.0)
    covariance = np.concatenate(covariances)
    cross_covariance = np.concatenate(cross_covariances)[: len(times_s) - 1]
    add_vibration(rest, times_s, observations.layout, covariance, cross_covariance)
    common = common_covariance(np.concatenate(displacements)) if displacements else None
    trajectory = Trajectory(concatenate_states(knots), prior, covariance, cross_covariance, adapted, common)
    return TrajectoryFit(
        trajectory,
        observations,
        scales,
        np.concatenate(residuals_m),
        np.concatenate(squared_distances),
        np.concatenate(weights),
        rest,
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
) -> _AdaptedSolution:
    """Solve, and adapt the process noise to the motion; arguments as for :func:`solve` and :func:`adapted_sigmas`."""
    sigmas = initial_sigmas
    solution = solve(observations, guess, prior, sigmas=sigmas, rest=rest)
    for _ in range(ADAPTATIONS):
        marginals = solution.factor.marginals()
        sigmas = adapted_sigmas(
            solution, *marginals, sigmas=sigmas, initial_sigmas=initial_sigmas, adaptable=adaptable
        )
        solution = solve(
            observations,
            solution.knots,
            prior,
            sigmas=sigmas,
            rest=rest,
            max_iterations=MAX_ADAPTED_ITERATIONS,
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
