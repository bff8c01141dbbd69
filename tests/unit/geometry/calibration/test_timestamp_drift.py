"""Wandering time stamps as random effects: against the same thing written out."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.geometry.calibration.timestamp_drift import SegmentInformation, eliminate_wander, estimate_wander_s

LATENCIES = np.array([3, 4])


def part(rng: np.random.Generator, *, unknowns: int = 5, size: float = 1.0) -> SegmentInformation:
    """Return what some piece might tell."""
    rows = size * rng.normal(size=(8, unknowns))
    return SegmentInformation(rows.T @ rows, size * rng.normal(size=unknowns))


def test_eliminating_is_the_same_as_noise_on_the_latencies() -> None:
    """What is left knows the unknowns as well as before, but for times late beside station 1, which wanders as well."""
    some = part(np.random.default_rng(0))
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


def test_the_gain_is_what_the_best_times_gain() -> None:
    """Half the cost falls by what the most probable times late, with what they cost themselves, take away."""
    some = part(np.random.default_rng(1))
    known = np.linalg.inv(0.25 * np.array([[2.0, 1.0], [1.0, 2.0]]))
    normal = known + some.information[np.ix_(LATENCIES, LATENCIES)]
    best = -np.linalg.solve(normal, some.gradient[LATENCIES])
    assert eliminate_wander(some, LATENCIES, 0.5).cost_reduction == pytest.approx(
        -(some.gradient[LATENCIES] @ best + 0.5 * best @ normal @ best)
    )


def test_the_size_is_found_without_bias() -> None:
    """The size of random latencies in many pieces comes back to a tenth, whatever else is unknown."""
    rng = np.random.default_rng(2)
    parts = []
    for _ in range(300):
        information = part(rng, size=300.0).information
        late = np.zeros(5)
        late[3:] = 0.01 * (rng.normal(size=2) - rng.normal())
        noise = np.linalg.cholesky(information) @ rng.normal(size=5)
        parts.append(SegmentInformation(information, information @ late + noise))
    nothing = SegmentInformation(1e-6 * np.eye(5), np.zeros(5))
    assert estimate_wander_s(parts, nothing, LATENCIES) == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("latencies", [LATENCIES, LATENCIES[:0]])
def test_without_evidence_nothing_wanders(latencies: np.ndarray) -> None:
    """Pieces that agree to the digit, or latencies that are held, say nothing of wandering."""
    some = part(np.random.default_rng(3))._replace(gradient=np.zeros(5))
    known = SegmentInformation(np.eye(5), np.zeros(5))
    assert estimate_wander_s([some] * 5, known, latencies) == 0.0
    assert estimate_wander_s([some], known, latencies) == 0.0
