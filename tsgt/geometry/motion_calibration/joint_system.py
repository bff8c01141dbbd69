"""The joint normal equations of the set-up and of the trajectories of all segments, trajectories eliminated. Sans-I/O.

A wrong set-up distorts the rigid robot as it moves. For a fixed set-up each segment's trajectory is solved and eliminated
(Schur complement through its banded factor). What remains is the information of the recording on the set-up's parameters
with the trajectory marginalised: a small system, of which priors and hypotheses are combinations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.batch import scale_noise, shared_knot_times
from tsgt.geometry.motion_calibration.timestamp_drift import SegmentInformation
from tsgt.geometry.rigid import matvec
from tsgt.geometry.trajectory import MIN_KNOT_SPACING_S, coupling, initial_guess, solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.motion_calibration.setup_parameters import Setup, SetupParameters
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations, Solution, States
    from tsgt.model import MotionPrior

SEGMENT_S = 40.0  # Length of a trajectory: bounds memory, and shows inconsistent segments
MAX_GAP_S = 5.0  # Of all stations; ends a segment, since a longer gap may prevent convergence
MIN_MEASUREMENTS = 30  # Segments with fewer are skipped


@dataclass(slots=True)
class Segment:
    """One segment of measurements, which no set-up has corrected, and its last trajectory."""

    observations: Observations
    knots: States | None = None
    latencies_s: FloatArray | float = 0.0


class JointSystem(NamedTuple):
    """The recording linearised at one set-up, by segment."""

    segments: list[SegmentInformation]
    cost: float
    measurements: int
    outliers: int

    def information(self) -> FloatArray:
        """(G, G) of all segments together."""
        total: FloatArray = np.sum([each.information for each in self.segments], axis=0)
        return 0.5 * (total + total.T)

    def gradient(self) -> FloatArray:
        """(G,) of half the cost."""
        total: FloatArray = np.sum([each.gradient for each in self.segments], axis=0)
        return total


def segment_rows(
    time_s: FloatArray, prism: NDArray[np.intp], *, max_segments: int | None = None
) -> list[NDArray[np.intp]]:
    """Rows of measurements, in the order of time, of segments of three prisms or more; at most so many, evenly spread.

    Raises GeometryError: too few measurements.
    """
    count = max(1, round(float(time_s[-1] - time_s[0]) / SEGMENT_S)) if len(time_s) else 0
    edges = np.linspace(time_s[0], time_s[-1], count + 1)[1:-1] if count else ()
    boundaries = np.concatenate(
        [np.searchsorted(time_s, edges), np.flatnonzero(np.diff(time_s) > MAX_GAP_S) + 1]
    )
    rows = np.split(np.arange(len(time_s)), np.unique(boundaries).astype(np.intp))
    usable = [some for some in rows if len(some) >= MIN_MEASUREMENTS and len(np.unique(prism[some])) >= 3]
    if not usable:
        raise GeometryError(
            f"too few measurements: no {SEGMENT_S:.0f} s of them have {MIN_MEASUREMENTS}, of at least 3 prisms"
        )
    if max_segments is not None and len(usable) > max_segments:
        usable = [usable[i] for i in np.linspace(0, len(usable) - 1, max_segments).round().astype(int)]
    return usable


def split_segments(observations: Observations, *, max_segments: int | None = None) -> list[Segment]:
    """Split measurements, in the order of time, into segments; see :func:`segment_rows`."""
    rows = segment_rows(observations.time_s, observations.prism, max_segments=max_segments)
    return [Segment(observations.select(some)) for some in rows]


def linearise_jointly(
    segments: Sequence[Segment],
    parameters: SetupParameters,
    setup: Setup,
    prior: MotionPrior,
    *,
    noise_scale: FloatArray | float = 1.0,
) -> JointSystem:
    """Solve the trajectories of all segments with a set-up, and eliminate them."""
    eliminated: list[SegmentInformation] = []
    cost, measurements, outliers = 0.0, 0, 0
    for segment in segments:
        observations = scale_noise(setup.applied(segment.observations), noise_scale)
        solution = _solve_trajectory(segment, observations, setup, prior)
        by_setup = parameters.jacobian(observations, solution.linearised, setup)
        eliminated.append(eliminate_trajectory(observations, solution, by_setup))
        cost += solution.cost
        measurements += len(observations)
        outliers += int(np.count_nonzero(solution.weights < 1.0))
    return JointSystem(eliminated, cost, measurements, outliers)


def _solve_trajectory(
    segment: Segment, observations: Observations, setup: Setup, prior: MotionPrior
) -> Solution:
    knots = segment.knots
    # While the times hardly change, the last knots are close enough and a better initial guess.
    if knots is None or np.abs(setup.latencies_s - segment.latencies_s).max() > MIN_KNOT_SPACING_S / 2:
        knots = initial_guess(observations, shared_knot_times(observations.time_s))
        segment.latencies_s = setup.latencies_s
    solution = solve(observations, knots, prior, reject_outliers=False)
    segment.knots = solution.knots
    return solution


def eliminate_trajectory(
    observations: Observations, solution: Solution, by_setup: FloatArray
) -> SegmentInformation:
    """Information on the set-up with the trajectory eliminated (Schur complement).

    ``by_setup``: (M, 3, G) Jacobian of the residuals at the solution.
    """
    information, cross, gradient = _normal_equations(observations, solution, by_setup)
    return SegmentInformation(information - solution.factor.quadratic_form(cross), gradient)


def _normal_equations(
    observations: Observations, solution: Solution, by_setup: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(G, G) of the set-up, (K, 18, G) of states and set-up, (G,) gradient of the set-up; nothing eliminated."""
    linearised, knots = solution.linearised, solution.knots
    cross = coupling(observations, linearised, solution.weights, solution.knot_index, len(knots), by_setup)
    whitening = np.linalg.inv(np.linalg.cholesky(linearised.covariance(observations)))
    whitening *= np.sqrt(solution.weights)[:, None, None]
    residuals = matvec(whitening, linearised.residuals_m)
    by_setup = whitening @ by_setup
    flat = by_setup.reshape(-1, by_setup.shape[2])
    return flat.T @ flat, cross, flat.T @ residuals.ravel()
