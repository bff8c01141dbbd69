"""Search for the maximum of an evidence."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.optimize import minimize

from tsgt.errors import GeometryError
from tsgt.geometry.batch.evidence_search import Curved, maximise, newton_step

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

MIXING = np.array([[3.0, 1.0, 0.0, 2.0], [0.0, 1.0, -4.0, 0.0], [1.0, 0.0, 1.0, 9.0], [0.5, -2.0, 0.0, 0.0]])


def log_evidence_of_variances(parameters: FloatArray) -> Curved:
    """Evidence of four logarithms of variances, mixed: with the information expected at its maximum."""
    mixed = MIXING @ parameters
    data = np.exp(np.array([0.3, -1.0, 2.0, 0.5]) - mixed)
    information = MIXING.T @ np.diag(30.0 * np.minimum(data, 1.0)) @ MIXING
    return Curved(float(-30.0 * (mixed + data).sum()), MIXING.T @ (30.0 * (data - 1.0)), information)


@pytest.mark.parametrize("limit", [5.0, 0.2])
def test_finds_the_maximum_within_bounds(limit: float) -> None:
    """As scipy's search does, with correlated parameters, and with some at their bounds."""
    lower, upper, start = np.full(4, -limit), np.full(4, limit), np.full(4, -0.1)

    def negative(parameters: FloatArray) -> float:
        return -log_evidence_of_variances(parameters).value

    expected = minimize(
        negative,
        start,
        method="L-BFGS-B",
        bounds=list(zip(lower, upper, strict=True)),
        options={"ftol": 1e-14, "gtol": 1e-9},
    )
    found, value = maximise(log_evidence_of_variances, start, lower, upper)
    assert value == pytest.approx(-expected.fun, abs=0.01)
    np.testing.assert_allclose(found, expected.x, atol=0.02)


@pytest.mark.parametrize("seed", range(8))
def test_newton_step_is_the_maximum_within_bounds(seed: int) -> None:
    """The slope is zero within the bounds, and points outwards at them; a parameter without room keeps its bound."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(12, 12)) * 10.0 ** rng.uniform(-1, 1, 12)
    information, gradient = root.T @ root, rng.normal(size=12)
    lowest, highest = -(10.0 ** rng.uniform(-3, 1, 12)), 10.0 ** rng.uniform(-3, 1, 12)
    lowest[:2], highest[:2] = 0.1, (0.1, 0.3)
    step = newton_step(Curved(0.0, gradient, information), lowest, highest)
    assert step[0] == 0.1
    assert ((step >= lowest) & (step <= highest)).all()
    # The parameter without room does not enter the equations of the others.
    slope = gradient[1:] - information[1:, 1:] @ step[1:]
    at_lowest, at_highest = step[1:] == lowest[1:], step[1:] == highest[1:]
    assert at_lowest.any() or at_highest.any()
    np.testing.assert_allclose(slope[~at_lowest & ~at_highest], 0.0, atol=1e-8)
    assert (slope[at_lowest] <= 1e-8).all()
    assert (slope[at_highest] >= -1e-8).all()


def test_avoids_points_without_a_solution() -> None:
    """A step that leads to where the function raises is shortened."""

    def limited(parameters: FloatArray) -> Curved:
        if parameters[0] > 0.5:
            raise GeometryError("singular")
        return Curved(float(parameters[0]), np.ones(1), np.full((1, 1), 1e-3))

    found, value = maximise(limited, np.zeros(1), np.full(1, -9.0), np.full(1, 9.0))
    assert 0.4 < found[0] <= 0.5
    assert value == pytest.approx(found[0], abs=1e-6)
