"""Search for the maximum of an evidence."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.optimize import minimize

from tsgt.errors import GeometryError
from tsgt.geometry.batch.evidence_search import Curved, maximise

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


def test_avoids_points_without_a_solution() -> None:
    """A step that leads to where the function raises is shortened."""

    def limited(parameters: FloatArray) -> Curved:
        if parameters[0] > 0.5:
            raise GeometryError("singular")
        return Curved(float(parameters[0]), np.ones(1), np.full((1, 1), 1e-3))

    found, value = maximise(limited, np.zeros(1), np.full(1, -9.0), np.full(1, 9.0))
    assert 0.4 < found[0] <= 0.5
    assert value == pytest.approx(found[0], abs=1e-6)
