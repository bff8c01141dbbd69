"""Maximum of a log evidence within bounds: Newton steps with the average information, in a trust region. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

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
    roots = np.sqrt(np.maximum(values, _LEAST_INFORMATION * values[-1]))
    towards = vectors.T @ here.gradient[free] / roots
    step[free] = lsq_linear(
        roots[:, None] * vectors.T, towards, (lowest[free], highest[free]), method="bvls"
    ).x
    return step
