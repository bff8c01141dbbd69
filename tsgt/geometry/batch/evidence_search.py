"""Maximum of a log evidence within bounds: Newton steps with the average information, in a trust region. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.rigid import FloatArray

_FIRST_RADIUS, _MAX_RADIUS, _MIN_RADIUS = 1.0, 2.0, 1e-3  # Largest change of a logarithm in one step
_TOLERANCE = 0.05
"""Predicted gain of the last step, which is not evaluated: a third of a sigma of one hyperparameter, and what then remains is far
below."""

_MAX_EVALUATIONS = 60
_LEAST_INFORMATION = 1e-9  # Relative to that on the best determined combination of parameters
_NEAR = 5.0
_SECANTS, _MIN_CURVATURE = 3, 0.2
_GOOD, _POOR = 0.5, 0.1  # Of the predicted gain
_MAX_ACTIVE_SETS = 200  # A handful suffices
_SLOPE_TOLERANCE = 1e-10  # Relative to the largest gradient; smaller slopes at a bound are rounding


class Curved(NamedTuple):
    """A function of parameters at one point."""

    value: float
    gradient: FloatArray  # (P,)
    information: FloatArray  # (P, P) negative curvature, approximate, not indefinite


def maximise(
    function: Callable[[FloatArray], Curved], start: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, float]:
    """Find parameters, (P,), that maximise a function within bounds, and the value there.

    A point at which the function raises GeometryError is avoided, except the first one.
    """
    at, here, radius = start, function(start), _FIRST_RADIUS
    steps: list[tuple[FloatArray, FloatArray]] = []  # And the decreases of the gradient by them
    for _ in range(_MAX_EVALUATIONS):
        model = _with_secants(here, steps)
        step = newton_step(model, np.maximum(lower - at, -radius), np.minimum(upper - at, radius))
        predicted = float(here.gradient @ step - 0.5 * step @ model.information @ step)
        if predicted < _TOLERANCE:
            return at + step, here.value + predicted
        try:
            there = function(at + step)
            gain = there.value - here.value
            if predicted < _NEAR:
                steps = [*steps, (step, here.gradient - there.gradient)][-_SECANTS:]
        except GeometryError:
            gain = -np.inf
        if gain > _GOOD * predicted:
            radius = min(2.0 * radius, _MAX_RADIUS)
        elif gain < _POOR * predicted:
            radius = 0.25 * min(radius, float(np.abs(step).max()))
        if gain > 0:
            at, here = at + step, there
        if radius < _MIN_RADIUS:
            break
    return at, here.value


def _with_secants(here: Curved, steps: list[tuple[FloatArray, FloatArray]]) -> Curved:
    """Correct the information by that which recent steps found along them (BFGS)."""
    information = here.information
    for step, decrease in steps:
        expected, found = information @ step, float(step @ decrease)
        if found > _MIN_CURVATURE * float(step @ expected):
            information = (
                information
                - np.outer(expected, expected) / float(step @ expected)
                + np.outer(decrease, decrease) / found
            )
    return here._replace(information=information)


def newton_step(here: Curved, lowest: FloatArray, highest: FloatArray) -> FloatArray:
    """(P,) maximum of the quadratic model within bounds of the step."""
    step = lowest.copy()
    free = highest > lowest
    values, vectors = np.linalg.eigh(here.information[np.ix_(free, free)])
    # Where the data say nothing about a combination of parameters, the bounds limit it.
    information = (vectors * np.maximum(values, _LEAST_INFORMATION * values[-1])) @ vectors.T
    step[free] = _bounded_maximum(here.gradient[free], information, lowest[free], highest[free])
    return step


def _bounded_maximum(
    gradient: FloatArray, information: FloatArray, lowest: FloatArray, highest: FloatArray
) -> FloatArray:
    """(P,) maximum of ``gradient @ x - x @ information @ x / 2`` within bounds, by active sets.

    P. B. Stark and R. L. Parker, "Bounded-variable least-squares: an algorithm and applications", Computational Statistics
    10, 1995. ``information``: positive definite.
    """
    x: FloatArray = np.clip(0.0, lowest, highest)
    at_bound = (x == lowest) | (x == highest)
    for _ in range(_MAX_ACTIVE_SETS):
        inside = ~at_bound
        # Move to the maximum of the free parameters, up to the first bound on the way.
        while inside.any():
            slope = (gradient - information @ x)[inside]
            towards = np.linalg.solve(information[np.ix_(inside, inside)], slope)
            bound = np.where(towards > 0, highest[inside], lowest[inside])
            with np.errstate(divide="ignore", invalid="ignore"):
                shares = np.where(towards != 0, (bound - x[inside]) / towards, np.inf)
            first = int(np.argmin(shares))
            rows = np.flatnonzero(inside)
            if shares[first] >= 1.0:
                x[rows] += towards
                break
            x[rows] += shares[first] * towards
            x[rows[first]] = bound[first]
            inside[rows[first]] = False
        at_bound = ~inside
        # Free the parameter whose bound the function rises from most steeply.
        slope = gradient - information @ x
        inwards = np.where(x == lowest, slope, -slope)
        inwards[inside] = 0.0
        worst = int(np.argmax(inwards))
        if inwards[worst] <= _SLOPE_TOLERANCE * (np.abs(gradient).max() + 1.0):
            break
        at_bound[worst] = False
    return x
