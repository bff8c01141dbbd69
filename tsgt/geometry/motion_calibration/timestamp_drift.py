"""Timestamp drift (wander) as a random effect in a calibration from motion. Sans-I/O.

Clock errors change over minutes and look like rotated frames. Each station gets an additional latency in each segment, all
with one variance, which restricted maximum likelihood estimates (D. A. Harville, Journal of the American Statistical
Association 72, 1977).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray

MIN_DISAGREEMENT_FREEDOM = 5.0  # Degrees of freedom below which the segments' disagreement says nothing
MIN_WANDER_S = 1e-5
MAX_WANDER_S = 0.1  # Bounds of the search: less is invisible with any instrument, more is no wander


class SegmentInformation(NamedTuple):
    """Information of one segment of a recording on G parameters, its trajectory eliminated."""

    information: FloatArray  # (G, G)
    gradient: FloatArray  # (G,) of half the cost


class WanderElimination(NamedTuple):
    """A segment with its random latencies eliminated."""

    segment: SegmentInformation
    cost_reduction: float  # By which half the segment's cost falls
    log_determinant: float  # Log ratio of the prior to the posterior information on the random latencies


def eliminate_wander(
    segment: SegmentInformation, latencies: NDArray[np.intp], wander_s: float
) -> WanderElimination:
    """Marginalise an additional latency of each station in a segment, with one sigma of ``wander_s``.

    ``latencies``, (n,), are the rows of the latencies in the parameters, of all stations but the first.
    """
    information, gradient = segment
    # Relative to station 1, whose own wander shifts all others alike.
    prior_covariance = wander_s**2 * (np.eye(len(latencies)) + 1.0)
    ratio = np.eye(len(latencies)) + prior_covariance @ information[np.ix_(latencies, latencies)]
    covariance = np.linalg.solve(ratio, prior_covariance)
    covariance = 0.5 * (covariance + covariance.T)
    cross = information[:, latencies]
    latency_gradient = gradient[latencies]
    eliminated = SegmentInformation(
        information - cross @ covariance @ cross.T, gradient - cross @ covariance @ latency_gradient
    )
    return WanderElimination(
        eliminated,
        0.5 * float(latency_gradient @ covariance @ latency_gradient),
        -float(np.linalg.slogdet(ratio)[1]),
    )


def estimate_wander_s(
    segments: Sequence[SegmentInformation],
    factor: FloatArray,
    deviation: FloatArray,
    latencies: NDArray[np.intp],
) -> float:
    """Return one sigma of the wander of latencies between segments; 0 without evidence for it.

    ``segments`` are linearised at one set-up, which differs from the prior's mean by ``factor @ deviation``; ``factor``,
    (G, r): of the prior covariance; ``latencies``, (n,): rows of the latencies.
    """
    if not len(latencies) or not factor[latencies].any() or len(segments) < 2:
        return 0.0

    def negative(log_wander: float) -> float:
        eliminated = [eliminate_wander(segment, latencies, float(np.exp(log_wander))) for segment in segments]
        total = np.sum([each.segment.information for each in eliminated], axis=0)
        information = np.eye(factor.shape[1]) + factor.T @ total @ factor
        gradient = deviation + factor.T @ np.sum([each.segment.gradient for each in eliminated], axis=0)
        log_likelihood = sum(each.cost_reduction + 0.5 * each.log_determinant for each in eliminated)
        log_likelihood += 0.5 * float(gradient @ np.linalg.solve(information, gradient))
        return -float(log_likelihood - 0.5 * np.linalg.slogdet(information)[1])

    bounds = (float(np.log(MIN_WANDER_S)), float(np.log(MAX_WANDER_S)))
    found = minimize_scalar(negative, bounds=bounds, method="bounded", options={"xatol": 0.01})
    # Without evidence the search stops just short of the lower bound.
    return float(np.exp(found.x)) if found.fun < negative(bounds[0]) - 1e-6 else 0.0


def birge_ratio(segments: Sequence[SegmentInformation], factor: FloatArray) -> float:
    """Birge ratio of segments, at their joint optimum: their disagreement over what noise explains, at least 1.

    R. T. Birge, Physical Review 40, 1932. ``factor``, (G, r): of the prior covariance.
    """
    joint = _posterior(np.sum([each.information for each in segments], axis=0), factor)
    squared = expected = 0.0
    for information, gradient in segments:
        covariance = _posterior(information, factor)
        squared += float(gradient @ covariance @ gradient)
        # The common optimum takes its share of each segment's disagreement.
        expected += float(np.trace(covariance @ (information - information @ joint @ information)))
    return max(1.0, float(np.sqrt(squared / expected))) if expected >= MIN_DISAGREEMENT_FREEDOM else 1.0


def _posterior(information: FloatArray, factor: FloatArray) -> FloatArray:
    """(G, G) covariance of the parameters from information and a prior."""
    inverse = np.linalg.inv(np.eye(factor.shape[1]) + factor.T @ information @ factor)
    covariance: FloatArray = factor @ inverse @ factor.T
    return covariance
