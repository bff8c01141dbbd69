"""Timestamp drift as a random effect: against dense formulas."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.geometry.motion_calibration.timestamp_drift import (
    SegmentInformation,
    eliminate_wander,
    estimate_wander_s,
)

LATENCIES = np.array([3, 4])


def random_segment(rng: np.random.Generator, *, unknowns: int = 5, size: float = 1.0) -> SegmentInformation:
    """Random information of one segment."""
    rows = size * rng.normal(size=(8, unknowns))
    return SegmentInformation(rows.T @ rows, size * rng.normal(size=unknowns))


def test_elimination_equals_noise_on_the_latencies() -> None:
    """The posterior covariance grows by the wander's, correlated by station 1; the optimum of the segment stays."""
    some = random_segment(np.random.default_rng(0))
    wander_s = 0.7
    left = eliminate_wander(some, LATENCIES, wander_s).segment
    noise = np.zeros((5, 5))
    noise[3:, 3:] = wander_s**2 * np.array([[2.0, 1.0], [1.0, 2.0]])
    covariance = np.linalg.inv(some.information) + noise
    assert np.linalg.inv(left.information) == pytest.approx(covariance, rel=1e-9)
    # The most probable unknowns of a piece alone stay what they are.
    assert np.linalg.solve(left.information, left.gradient) == pytest.approx(
        np.linalg.solve(some.information, some.gradient), rel=1e-9
    )


def test_cost_reduction_is_that_of_the_optimal_latencies() -> None:
    """Half the cost falls by what the most probable latencies gain, minus their prior's cost."""
    some = random_segment(np.random.default_rng(1))
    known = np.linalg.inv(0.25 * np.array([[2.0, 1.0], [1.0, 2.0]]))
    normal = known + some.information[np.ix_(LATENCIES, LATENCIES)]
    best = -np.linalg.solve(normal, some.gradient[LATENCIES])
    assert eliminate_wander(some, LATENCIES, 0.5).cost_reduction == pytest.approx(
        -(some.gradient[LATENCIES] @ best + 0.5 * best @ normal @ best)
    )


def test_wander_estimate_is_unbiased() -> None:
    """The sigma of random latencies in many segments is recovered within a tenth."""
    rng = np.random.default_rng(2)
    parts = []
    for _ in range(300):
        information = random_segment(rng, size=300.0).information
        late = np.zeros(5)
        late[3:] = 0.01 * (rng.normal(size=2) - rng.normal())
        noise = np.linalg.cholesky(information) @ rng.normal(size=5)
        parts.append(SegmentInformation(information, information @ late + noise))
    assert estimate_wander_s(parts, 1e3 * np.eye(5), np.zeros(5), LATENCIES) == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("latencies", [LATENCIES, LATENCIES[:0]])
def test_no_wander_without_evidence(latencies: np.ndarray) -> None:
    """Consistent segments, or fixed latencies, give zero."""
    some = random_segment(np.random.default_rng(3))._replace(gradient=np.zeros(5))
    known = np.eye(5), np.zeros(5)
    assert estimate_wander_s([some] * 5, *known, latencies) == 0.0
    assert estimate_wander_s([some], *known, latencies) == 0.0
