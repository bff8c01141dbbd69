"""The clock line's Kalman filter against batch least squares."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.timesync.clock_line import ClockLine

WALK_PPM2_PER_S = 0.3
TIMES_S = np.array([0.0, 0.4, 0.9, 1.3, 8.0, 8.4, 9.1])
VARIANCES = np.array([4.0, 1.0, 9.0, 4.0, 1.0, 2.0, 4.0])
OFFSETS_US = np.array([0.0, 3.0, 4.0, 9.0, 70.0, 77.0, 75.0])
PRIOR = ClockLine(1.0, 5.0, 100.0, 3.0, 50.0)
UNKNOWN = ClockLine(0.0, 0.0, 1e9, 0.0, 1e9)


def forward(until_s: float) -> ClockLine:
    """Filter the samples up to an instant, and propagate to it."""
    estimate, at_s = PRIOR, 0.0
    for time_s, offset_us, variance in zip(TIMES_S, OFFSETS_US, VARIANCES, strict=True):
        if time_s > until_s:
            break
        predicted = estimate.propagate(time_s - at_s, WALK_PPM2_PER_S * (time_s - at_s))
        estimate = predicted.update(offset_us, variance)
        at_s = time_s
    return estimate.propagate(until_s - at_s, WALK_PPM2_PER_S * (until_s - at_s))


def backward(until_s: float) -> ClockLine:
    """Filter the samples after an instant, newest first, and propagate to it."""
    estimate, at_s = UNKNOWN, float(TIMES_S[-1])
    for time_s, offset_us, variance in zip(TIMES_S[::-1], OFFSETS_US[::-1], VARIANCES[::-1], strict=True):
        if time_s <= until_s:
            break
        predicted = estimate.propagate(time_s - at_s, WALK_PPM2_PER_S * (at_s - time_s))
        estimate = predicted.update(offset_us, variance)
        at_s = time_s
    return estimate.propagate(until_s - at_s, WALK_PPM2_PER_S * (at_s - until_s))


def batch(time_s: float) -> ClockLine:
    """Solve for offset and skew at all times together by least squares, and return one of them."""
    times_s = np.unique([*TIMES_S, time_s])
    size = 2 * len(times_s)
    information, vector = np.zeros((size, size)), np.zeros(size)

    def observe(rows: np.ndarray, values: np.ndarray, covariance: np.ndarray) -> None:
        weight = np.linalg.inv(covariance)
        information[:] += rows.T @ weight @ rows
        vector[:] += rows.T @ weight @ values

    prior = np.array([[PRIOR.offset_variance, PRIOR.covariance], [PRIOR.covariance, PRIOR.skew_variance]])
    observe(np.eye(2, size), np.array(PRIOR[:2]), prior)
    for k, gap_s in enumerate(np.diff(times_s)):
        rows = np.zeros((2, size))
        rows[:, 2 * k : 2 * k + 2] = -np.array([[1.0, gap_s], [0.0, 1.0]])
        rows[:, 2 * k + 2 : 2 * k + 4] = np.eye(2)
        walk = WALK_PPM2_PER_S * np.array([[gap_s**3 / 3, gap_s**2 / 2], [gap_s**2 / 2, gap_s]])
        observe(rows, np.zeros(2), walk)
    for compared_s, offset_us, variance in zip(TIMES_S, OFFSETS_US, VARIANCES, strict=True):
        row = np.zeros((1, size))
        row[0, 2 * int(np.searchsorted(times_s, compared_s))] = 1.0
        observe(row, np.array([offset_us]), np.array([[variance]]))
    covariance = np.linalg.inv(information)
    values, k = covariance @ vector, 2 * int(np.searchsorted(times_s, time_s))
    return ClockLine(
        values[k], values[k + 1], covariance[k, k], covariance[k, k + 1], covariance[k + 1, k + 1]
    )


def test_forward_filter_is_the_batch_solution_at_the_end() -> None:
    """Beyond the last sample the filter equals the batch least-squares solution."""
    assert tuple(forward(9.6)) == pytest.approx(tuple(batch(9.6)), rel=1e-6)


@pytest.mark.parametrize("time_s", [0.2, 1.1, 4.0, 8.2, 9.0])
def test_fused_filters_are_the_batch_solution(time_s: float) -> None:
    """Between samples the fused forward and backward filters equal the batch least-squares solution."""
    assert tuple(forward(time_s).fuse(backward(time_s))) == pytest.approx(tuple(batch(time_s)), rel=1e-5)


def test_backward_propagation_inverts_forward_propagation() -> None:
    """Without a random walk propagation is reversible."""
    there = PRIOR.propagate(7.0, 0.0)
    assert tuple(there.propagate(-7.0, 0.0)) == pytest.approx(tuple(PRIOR), rel=1e-9)
