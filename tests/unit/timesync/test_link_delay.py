"""The link delay from two-way exchanges."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.timesync import LinkDelayEstimator

NOMINAL_NS = 1_489_480
SYMBOL_NS = 2_048_000


def measured(
    link_ns: int, exchanges: int, *, jitter_us: float = 20.0, seed: int = 0
) -> tuple[LinkDelayEstimator, int]:
    """Return the estimator after some exchanges with jitter on each of four timestamps, and the number of rejections."""
    trip, rng, alarms = LinkDelayEstimator(NOMINAL_NS, SYMBOL_NS), np.random.default_rng(seed), 0
    for _ in range(exchanges):
        jitter_ns = rng.normal(0.0, 1000 * jitter_us, 4).sum() + rng.normal(0.0, 3_000, 2).sum()
        alarms += not trip.add(round(2 * link_ns + jitter_ns))
    return trip, alarms


def test_initial_estimate_is_nominal() -> None:
    """The prior bound is a fifth of a symbol."""
    trip = LinkDelayEstimator(NOMINAL_NS, SYMBOL_NS)
    assert (trip.link_delay_ns, trip.exchanges) == (NOMINAL_NS, 0)
    assert trip.bound_ns == pytest.approx(0.2 * SYMBOL_NS, rel=0.01)


@pytest.mark.parametrize(("exchanges", "p99_us", "bound_us"), [(8, 22, 100), (64, 8, 25), (256, 5, 15)])
@pytest.mark.slow
def test_error_falls_with_the_number_of_exchanges(exchanges: int, p99_us: float, bound_us: float) -> None:
    """With 20 us of jitter on each timestamp: 20 us after 8 exchanges, 7 us after 64."""
    trips = [measured(NOMINAL_NS + 150_000, exchanges, seed=seed)[0] for seed in range(100)]
    errors_us = [abs(trip.link_delay_ns - NOMINAL_NS - 150_000) / 1000 for trip in trips]
    assert np.quantile(errors_us, 0.99) < p99_us
    assert np.median([trip.bound_ns for trip in trips]) < 1000 * bound_us


@pytest.mark.parametrize("jitter_us", [3.0, 20.0, 200.0, 1000.0])
def test_bound_contains_the_truth(jitter_us: float) -> None:
    """For any possible link delay, number of exchanges and jitter."""
    for seed in range(30):
        link_ns = NOMINAL_NS + round(np.random.default_rng(seed).uniform(-0.2, 0.2) * SYMBOL_NS)
        for exchanges in (1, 2, 4, 7, 8, 10, 20, 60):
            trip, _ = measured(link_ns, exchanges, jitter_us=jitter_us, seed=seed)
            assert abs(trip.link_delay_ns - link_ns) <= trip.bound_ns


def test_usual_jitter_is_not_rejected() -> None:
    """Fewer than one exchange in a thousand is rejected."""
    assert sum(measured(NOMINAL_NS, 200, seed=seed)[1] for seed in range(20)) <= 4


def test_delayed_packet_is_rejected() -> None:
    """A beacon 0.3 ms late makes the round trip 0.3 ms longer; the estimate does not change."""
    trip, _ = measured(NOMINAL_NS, 64)
    before_ns = trip.link_delay_ns
    for _ in range(50):
        assert not trip.add(2 * NOMINAL_NS + 300_000)
    assert trip.link_delay_ns == before_ns


def test_anomaly_is_reported_until_it_ends() -> None:
    """The whole extra delay is reported, as it may be on one of the two ways; 0 after the next consistent exchange."""
    trip, _ = measured(NOMINAL_NS, 64)
    assert trip.anomaly_ns == 0
    trip.add(2 * NOMINAL_NS + 3_000_000)
    assert trip.anomaly_ns == pytest.approx(3_000_000, abs=30_000)
    trip.add(2 * NOMINAL_NS)
    assert trip.anomaly_ns == 0


def test_impossible_first_exchange_is_rejected() -> None:
    """The first exchange is compared with the nominal delay."""
    trip = LinkDelayEstimator(NOMINAL_NS, SYMBOL_NS)
    assert not trip.add(2 * NOMINAL_NS + 2 * SYMBOL_NS)
    assert (trip.link_delay_ns, trip.exchanges) == (NOMINAL_NS, 0)


def test_outlier_at_the_start_is_outvoted() -> None:
    """The first exchange is 0.4 ms off; after eight the estimate is right."""
    trip = LinkDelayEstimator(NOMINAL_NS, SYMBOL_NS)
    trip.add(2 * NOMINAL_NS + 800_000)
    for k in range(7):
        trip.add(2 * NOMINAL_NS + 20_000 * (k % 3 - 1))
    assert abs(trip.link_delay_ns - NOMINAL_NS) < 20_000
    assert abs(trip.link_delay_ns - NOMINAL_NS) <= trip.bound_ns


def test_coarse_timestamps_widen_the_gate() -> None:
    """With timestamps of 1 ms sigma exchanges are rejected only at first."""
    alarms = [measured(NOMINAL_NS, 100, jitter_us=1000, seed=seed)[1] for seed in range(10)]
    assert max(alarms) < 10
