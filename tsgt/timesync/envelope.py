"""The line below answers that are late by chance, never early: how high it lies, how steep, and how well that is known.

Over instrument time the answers lie above a straight line, late by anything from 0 to a spread. Given the slope, the line
cannot be above the lowest answer, and is probably less than spread / number of answers below it. Where it is steeper, the
lowest answer is another one, and on average the answers lie higher above it: the more answers there are, the less likely
is a slope that leaves room below them. Over all slopes, each weighed by that and by what was known of it before, the mean
and the scatter of the line are those that squares of errors are smallest with (Pitman's estimator).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

_SLOPES: Final = 24
"""So many slopes are tried at a time."""

_ZOOMS: Final = 5
_FINE: Final = 1.5
"""Slopes are close enough when they are no further apart than one sigma over this."""


class Lowest(NamedTuple):
    """How far the lowest of some answers lies above the line.

    Attributes
    ----------
    mean, sigma
        Mean and standard deviation, in units of the resolution.
    """

    mean: float
    sigma: float


def lowest(share: float) -> Lowest:
    """Return how far the lowest answer is from the line, where both are cut off to whole units before they are compared.

    An answer is above the line by how late it is, evenly from 0 to a spread, and by what was cut off, evenly from 0 to 1.
    Below a height s less than 1 lie s^2 / 2 of a spread, below a higher one s - 1/2.

    Parameters
    ----------
    share
        The spread over the number of answers and one, in the same units, more than 0; for eight answers or more.
    """
    below_one = math.exp(-0.5 / share)
    mean = math.sqrt(math.pi * share / 2) * math.erf(math.sqrt(0.5 / share)) + share * below_one
    square = 2 * share + 2 * share**2 * below_one
    return Lowest(mean, math.sqrt(max(square - mean**2, 0.0)))


class Line(NamedTuple):
    """What is known of a line.

    Attributes
    ----------
    height, slope
        It goes through (0, height); as high as answers allow: on average over the slopes it touches the lowest.
    slope_sigma
        Standard deviation of the slope.
    pivot
        Where the line's height does not depend on the slope.
    pivot_sigma
        Standard deviation of its height there, for want of a better slope; that of the lowest answer comes on top.
    """

    height: float
    slope: float
    slope_sigma: float
    pivot: float
    pivot_sigma: float


def line_below(
    points: Sequence[tuple[float, float]],
    *,
    middle: float,
    scale: float,
    known: tuple[float, float],
    most: float,
) -> Line:
    """Lay a line below points.

    Parameters
    ----------
    points
        The lowest ones, in any order, at least one.
    middle
        Mean position of all.
    scale
        How far below the lowest answer the line is, on average.
    known
        Slope, and standard deviation of it, that were known before.
    most
        The slope is not more than this, up or down.
    """
    corners = _hull(points)
    known_slope, known_sigma = known
    low, high = -most, most
    for _ in range(_ZOOMS):
        step = (high - low) / (_SLOPES - 1)
        slopes = [low + i * step for i in range(_SLOPES)]
        heights = [min(y - slope * x for x, y in corners) for slope in slopes]
        exponents = [
            (height + slope * middle) / scale - 0.5 * ((slope - known_slope) / known_sigma) ** 2
            for slope, height in zip(slopes, heights, strict=True)
        ]
        best = max(exponents)
        weights = [math.exp(exponent - best) for exponent in exponents]
        total = sum(weights)
        slope = sum(w * b for w, b in zip(weights, slopes, strict=True)) / total
        square = sum(w * (b - slope) ** 2 for w, b in zip(weights, slopes, strict=True)) / total
        sigma = math.sqrt(square)
        if sigma > _FINE * step:
            break
        wide = max(4 * sigma, 1.5 * step)
        low, high = slope - wide, slope + wide
    height = sum(w * a for w, a in zip(weights, heights, strict=True)) / total
    together = (
        sum(w * (a - height) * (b - slope) for w, a, b in zip(weights, heights, slopes, strict=True)) / total
    )
    scatter = sum(w * (a - height) ** 2 for w, a in zip(weights, heights, strict=True)) / total
    pivot = -together / square if square > 0 else middle
    pivot_sigma = math.sqrt(max(scatter - pivot**2 * square, 0.0))
    return Line(height, slope, sigma, pivot, pivot_sigma)


def _hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points that a line from below can touch, from left to right."""
    corners: list[tuple[float, float]] = []
    for x, y in sorted(points):
        while len(corners) > 1:
            (x1, y1), (x2, y2) = corners[-2:]
            if (y2 - y1) * (x - x1) < (y - y1) * (x2 - x1):
                break
            corners.pop()
        corners.append((x, y))
    return corners
