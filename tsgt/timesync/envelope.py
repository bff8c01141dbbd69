"""The lower envelope of responses that are delayed at random, never early: its height, its slope, and their errors.

The responses lie above a line by 0 to a spread. Given the slope, the line is not above the lowest response, and probably
less than spread / number of responses below it; a slope that leaves room below many responses is unlikely. Mean and
covariance over all slopes, weighted by that and the prior, minimise the mean square error (Pitman 1939).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

_GRID_SLOPES: Final = 24
_MAX_REFINEMENTS: Final = 5
_STEPS_PER_SIGMA: Final = 1.5
"""The grid of slopes is refined until one sigma of the slope spans this many steps."""


class MinimumDelay(NamedTuple):
    """Mean and standard deviation of the lowest response's height above the line, in units of the resolution."""

    mean: float
    sigma: float


def minimum_delay(share: float) -> MinimumDelay:
    """Return the height of the lowest response above the line, where times are truncated to whole units.

    A response is above the line by its delay, uniform from 0 to a spread, and by the truncation, uniform from 0 to 1. A
    height s below 1 has the probability s^2 / 2 over the spread, a larger one s - 1/2. ``share``: the spread over the
    number of responses plus one, in the same units, above 0; for eight responses or more.
    """
    below_one = math.exp(-0.5 / share)
    mean = math.sqrt(math.pi * share / 2) * math.erf(math.sqrt(0.5 / share)) + share * below_one
    square = 2 * share + 2 * share**2 * below_one
    return MinimumDelay(mean, math.sqrt(max(square - mean**2, 0.0)))


class LowerEnvelope(NamedTuple):
    """A line below points, with its errors.

    Attributes
    ----------
    height, slope
        The line goes through (0, height) and touches the lowest response, on average over the slopes.
    slope_sigma
        Standard deviation of the slope.
    pivot
        Position at which the line's height is uncorrelated with the slope.
    pivot_sigma
        Standard deviation of the height there; add that of :class:`MinimumDelay`.
    """

    height: float
    slope: float
    slope_sigma: float
    pivot: float
    pivot_sigma: float


def fit_lower_envelope(
    points: Sequence[tuple[float, float]],
    *,
    centre: float,
    scale: float,
    prior: tuple[float, float],
    max_slope: float,
) -> LowerEnvelope:
    """Fit a line below points.

    Parameters
    ----------
    points
        The lowest ones, in any order, at least one.
    centre
        Mean position of all responses.
    scale
        Mean distance of the line below the lowest response.
    prior
        Slope and its standard deviation.
    max_slope
        Bound of the slope's magnitude.
    """
    corners = lower_hull(points)
    prior_slope, prior_sigma = prior
    low, high = -max_slope, max_slope
    for _ in range(_MAX_REFINEMENTS):
        step = (high - low) / (_GRID_SLOPES - 1)
        slopes = [low + i * step for i in range(_GRID_SLOPES)]
        heights = [min([y - slope * x for x, y in corners]) for slope in slopes]
        log_weights = [
            (height + slope * centre) / scale - 0.5 * ((slope - prior_slope) / prior_sigma) ** 2
            for slope, height in zip(slopes, heights, strict=True)
        ]
        largest = max(log_weights)
        weights = [math.exp(log_weight - largest) for log_weight in log_weights]
        total = sum(weights)
        slope = sum([w * b for w, b in zip(weights, slopes, strict=True)]) / total
        slope_variance = sum([w * (b - slope) ** 2 for w, b in zip(weights, slopes, strict=True)]) / total
        sigma = math.sqrt(slope_variance)
        if sigma > _STEPS_PER_SIGMA * step:
            break
        half_width = max(4 * sigma, 1.5 * step)
        low, high = slope - half_width, slope + half_width
    height = sum(w * a for w, a in zip(weights, heights, strict=True)) / total
    covariance = (
        sum(w * (a - height) * (b - slope) for w, a, b in zip(weights, heights, slopes, strict=True)) / total
    )
    height_variance = sum(w * (a - height) ** 2 for w, a in zip(weights, heights, strict=True)) / total
    pivot = -covariance / slope_variance if slope_variance > 0 else centre
    pivot_sigma = math.sqrt(max(height_variance - pivot**2 * slope_variance, 0.0))
    return LowerEnvelope(height, slope, sigma, pivot, pivot_sigma)


def lower_hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the lower convex hull from left to right (monotone chain: Andrew 1979)."""
    corners: list[tuple[float, float]] = []
    for x, y in sorted(points):
        while len(corners) > 1:
            (x1, y1), (x2, y2) = corners[-2:]
            if (y2 - y1) * (x - x1) < (y - y1) * (x2 - x1):
                break
            corners.pop()
        corners.append((x, y))
    return corners
