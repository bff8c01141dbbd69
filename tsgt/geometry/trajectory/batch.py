"""The smooth trajectory of a whole recording, of any length. Pure.

What happened half a minute ago says nothing of where a robot is now that the measurements since do not say better. So a
long recording is solved in pieces that overlap, and memory for the equations stays bounded; the result is that of one
piece to far below the noise. Memory for what is kept is about 140 MB per hour of 3 stations at 2.5 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.trajectory.gauss_newton import knot_times, nearest_knots, solve
from tsgt.geometry.trajectory.hyperparameters import (
    NOISE_FLOOR_SHARE,
    partially_occluded,
    scale_noise,
    tune,
    with_noise_floor,
)
from tsgt.geometry.trajectory.initialisation import PrismTracks
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.geometry.trajectory.query import Trajectory
from tsgt.geometry.trajectory.states import concatenate_states
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations

KNOTS_AT_ONCE = 1024
"""About two minutes of 3 stations at 2.5 Hz: their blocks fit into a cache."""

OVERLAP = 128
"""Knots on either side of a piece that are solved with it and left to its neighbours."""


@dataclass(frozen=True, slots=True)
class TrajectoryFit:
    """A trajectory fitted to measurements.

    Attributes
    ----------
    trajectory
        The robot's motion with its uncertainty.
    observations
        The M measurements that it was fitted to; their noise is the stated one times ``noise_scale``.
    noise_scale
        The measurements scatter by so many times the stated noise of their instruments.
    residuals_m
        (M, 3) trajectory less measurement: along the line of sight, horizontally and vertically across it.
    distances
        (M,) squared distances of the measurements from the trajectory, in sigmas of their noise.
    weights
        (M,) what each of them counts: 1, or less for an outlier.
    """

    trajectory: Trajectory
    observations: Observations
    noise_scale: float
    residuals_m: FloatArray
    squared_distances: FloatArray
    weights: FloatArray

    @property
    def prior(self) -> MotionPrior:
        """How the robot moves."""
        return self.trajectory.prior


class _Piece(NamedTuple):
    """Knots by their numbers: those that are solved, and those of them that are kept."""

    solved: slice
    kept: slice


def fit_trajectory(
    observations: Observations,
    *,
    prior: MotionPrior | None = None,
    occluded_prior: MotionPrior | None = None,
    noise_scale: float | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> TrajectoryFit:
    """Fit a trajectory.

    Parameters
    ----------
    observations
        In the order of time, with the stated noise of the instruments.
    prior
        How the robot moves; found from the measurements when not given.
    while_hidden
        How lively it is at least while fewer than three prisms are seen; no other than ``prior`` when only that is given.
    noise_scale
        By what their stated noise is multiplied; found from the measurements when not given.
    on_progress
        Called now and then with the share of the work that is done, 0 to 1.

    Raises
    ------
    GeometryError
        Fewer than three prisms were measured, or too little to tell what is asked for.
    """
    report = on_progress or (lambda _: None)
    if prior is None or noise_scale is None:
        tuned = tune(observations, start=prior, noise_scale=noise_scale, fixed=prior is not None)
        noise_scale = tuned.noise_scale
        if prior is None:
            prior = with_noise_floor(tuned.prior, MotionPrior(), NOISE_FLOOR_SHARE)
            occluded_prior = occluded_prior or MotionPrior()
    observations = scale_noise(observations, noise_scale)
    times_s = knot_times(observations.time_s)
    at = nearest_knots(times_s, observations.time_s)
    sigmas = _sigmas(observations, times_s, prior, occluded_prior or prior)
    pieces = _pieces(len(times_s))
    tracks = PrismTracks.of(observations)
    knots, covariances, besides, residuals_m, squared_distances, weights = [], [], [], [], [], []
    for done, piece in enumerate(pieces):
        report(done / len(pieces))
        rows = slice(
            *np.searchsorted(at, (piece.solved.start, piece.solved.stop)),
        )
        guess = tracks.guess(times_s[piece.solved])
        between = slice(piece.solved.start, piece.solved.stop - 1)
        solution = solve(observations.select(rows), guess, prior, sigmas=sigmas[between])
        covariance, cross_covariance = solution.factor.marginals()
        inner = slice(piece.kept.start - piece.solved.start, piece.kept.stop - piece.solved.start)
        knots.append(solution.knots.select(inner))
        covariances.append(covariance[inner])
        besides.append(cross_covariance[inner])
        kept = slice(*np.searchsorted(at[rows], (piece.kept.start, piece.kept.stop)))
        # Not the whole solution: its factor is as large as all that is kept.
        residuals_m.append(solution.linearised.residuals_m[kept])
        squared_distances.append(solution.squared_distances[kept])
        weights.append(solution.weights[kept])
    report(1.0)
    trajectory = Trajectory(
        concatenate_states(knots),
        prior,
        np.concatenate(covariances),
        np.concatenate(besides)[: len(times_s) - 1],
        sigmas,
    )
    return TrajectoryFit(
        trajectory,
        observations,
        noise_scale,
        np.concatenate(residuals_m),
        np.concatenate(squared_distances),
        np.concatenate(weights),
    )


def _sigmas(
    observations: Observations, times_s: FloatArray, prior: MotionPrior, occluded_prior: MotionPrior
) -> FloatArray:
    """(K - 1, 6) one sigma of the acceleration of each axis, from knot to knot."""
    unseen = partially_occluded(observations.time_s, observations.prism, 0.5 * (times_s[:-1] + times_s[1:]))
    return np.where(unseen[:, None], axis_sigmas(with_noise_floor(prior, occluded_prior)), axis_sigmas(prior))


def _pieces(count: int) -> list[_Piece]:
    """Divide knots into pieces of about equal length."""
    number = max(-(-count // KNOTS_AT_ONCE), 1)
    ends = [round(i * count / number) for i in range(number + 1)]
    return [
        _Piece(slice(max(start - OVERLAP, 0), min(stop + OVERLAP, count)), slice(start, stop))
        for start, stop in pairwise(ends)
    ]
