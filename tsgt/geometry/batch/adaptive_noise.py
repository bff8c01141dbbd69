"""Process noise that follows the motion: more where the robot manoeuvres, less where it drives steadily. Sans-I/O.

A robot accelerates in bursts. One sigma for all of a drive is too small for the bursts and too large between them. Given a
solution, the expected squared distance of each process residual says how well its sigma describes that step: 3 on average if
it does, and also where the measurements say nothing. The sigmas of neighbouring steps are scaled by the mean of these distances:
a step of expectation maximisation for process noise with a slowly varying scale, extrapolated.
See docs/explanation/continuous-trajectory.md, "Process noise that follows the motion".
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.batch.process_moments import expected_moments, expected_squared_distances

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution

ADAPTATIONS = 2
HALF_WINDOW_S = 1.0  # Of the mean of the squared distances: a manoeuvre lasts about a second
PRIOR_STEPS = 5.0  # Steps that agree with the sigma, added to the mean: half as many as a window has
EXTRAPOLATION = 6.0
"""Power of the ratio by which a variance is scaled. A single step goes a small part of the way, because the measurements determine
only part of each residual; this many more go as far as two steps can without overshooting."""

MIN_VARIANCE_RATIO, MAX_VARIANCE_RATIO = 0.1, 10.0
_AXES_TOGETHER = ((0, 1), (2,), (3, 4), (5,))  # As in the tuned prior: x and y, z, roll and pitch, yaw
_FREEDOM = 3.0


def adapted_sigmas(
    solution: Solution,
    covariance: FloatArray,
    cross_covariance: FloatArray,
    *,
    sigmas: FloatArray,
    initial_sigmas: FloatArray,
    adaptable: NDArray[np.bool_],
) -> FloatArray:
    """Adapt the acceleration sigmas of the K - 1 steps to a solution that was found with them.

    Parameters
    ----------
    covariance, cross_covariance : Marginals of the solution.
    sigmas, initial_sigmas : (K - 1, 6), those of the solution, and those that bound how far they change.
    adaptable : (K - 1,) steps of which the measurements tell the motion; the others keep their sigmas.
    """
    process = solution.process
    moments = expected_moments(solution, covariance, cross_covariance)
    distances = expected_squared_distances(moments, process.phi, process.information) / _FREEDOM
    time_s = solution.knots.time_s
    middle_s = 0.5 * (time_s[1:] + time_s[:-1])
    bounds = np.searchsorted(middle_s, [middle_s - HALF_WINDOW_S, middle_s + HALF_WINDOW_S])
    counts = _sums(adaptable.astype(np.float64), bounds)
    variances = sigmas**2
    for axes in map(list, _AXES_TOGETHER):
        total = _sums(np.where(adaptable, distances[:, axes].mean(axis=1), 0.0), bounds)
        ratio = (total + PRIOR_STEPS) / (counts + PRIOR_STEPS)
        variances[:, axes] *= ratio[:, None] ** EXTRAPOLATION
    limited = np.clip(
        variances, MIN_VARIANCE_RATIO * initial_sigmas**2, MAX_VARIANCE_RATIO * initial_sigmas**2
    )
    return np.where(adaptable[:, None], np.sqrt(limited), sigmas)


def _sums(values: FloatArray, bounds: NDArray[np.intp]) -> FloatArray:
    """Add up the rows from ``bounds[0]`` to before ``bounds[1]``."""
    cumulative = np.concatenate([[0.0], np.cumsum(values)])
    sums: FloatArray = cumulative[bounds[1]] - cumulative[bounds[0]]
    return sums
