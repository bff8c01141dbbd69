"""The instrument's time on the host's clock, bounded by two-way exchanges over a network."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from tsgt.timesync import ExchangeClock
from tsgt.timesync.exchange_clock import MIN_EXCHANGES

MS = 1_000_000
SWITCHED_ON_NS = 77_000_000_000_000


class Network(NamedTuple):
    """Delays in ms: fastest request and fastest response, mean of the jitter, share of bursts of 200 to 800 ms."""

    request: float = 3.0
    response: float = 3.0
    jitter: float = 5.0
    bursts: float = 0.05

    def delay_ns(self, fastest: float, rng: np.random.Generator) -> float:
        """Return the delay of a packet."""
        burst = rng.uniform(200.0, 800.0) if rng.random() < self.bursts else 0.0
        return (fastest + rng.exponential(self.jitter) + burst) * MS


def instrument_ms(host_ns: float, ppm: float = 20.0) -> int:
    """Return what the instrument's clock shows."""
    return int((host_ns - SWITCHED_ON_NS) * (1 + ppm * 1e-6) // MS)


def errors(network: Network, *, seed: int, ppm: float = 20.0, exchanges: int = 300) -> np.ndarray:
    """Return rows of error, sigma and bound (ms) of times 0.2 s after each exchange."""
    rng, clock, rows = np.random.default_rng(seed), ExchangeClock(), []
    for number in range(exchanges):
        sent_ns = SWITCHED_ON_NS + 60e9 + number * 0.5e9
        measured_ns = sent_ns + network.delay_ns(network.request, rng)
        arrived_ns = measured_ns + rng.uniform(5e6, 10e6) + network.delay_ns(network.response, rng)
        assert clock.add(instrument_ms(measured_ns, ppm), round(sent_ns), round(arrived_ns))
        assert not clock.inconsistent
        now_ns = arrived_ns + 0.2e9
        time = clock.at(instrument_ms(now_ns, ppm))
        if time is not None:
            rows.append(np.array([time.host_ns - now_ns, time.sigma_ns, time.bound_ns]) / MS)
    return np.array(rows)


def test_no_time_before_initialisation() -> None:
    """One exchange bounds a time, but may be corrupted."""
    clock = ExchangeClock()
    for number in range(MIN_EXCHANGES):
        assert clock.at(1000) is None
        assert clock.add(
            1000 + 500 * number, SWITCHED_ON_NS + 500 * number * MS, SWITCHED_ON_NS + (500 * number + 30) * MS
        )
    assert clock.at(1000) is not None


@pytest.mark.parametrize(
    ("network", "ppm"),
    [
        (Network(), 20.0),
        (Network(), -200.0),
        (Network(request=1.0, response=30.0), 20.0),
        (Network(request=30.0, response=1.0), 20.0),
        (Network(jitter=50.0, bursts=0.3), 20.0),
        (Network(jitter=0.0, bursts=1.0), 20.0),
    ],
)
def test_error_is_within_the_bound_whatever_the_delays(network: Network, ppm: float) -> None:
    """Asymmetry, jitter, bursts and skew: never outside the bound, and by sigma as one of a uniform distribution."""
    rows = errors(network, seed=1, ppm=ppm)
    assert (abs(rows[:, 0]) <= rows[:, 2]).all()
    assert (abs(rows[:, 0]) <= 2.2 * rows[:, 1]).all()


def test_uncertainty_is_that_of_the_fastest_round_trip() -> None:
    """Not of the mean one: 11 ms fastest, 0.05 * 500 ms and more on average."""
    rows = errors(Network(), seed=2)
    assert 11 / 12**0.5 < rows[-1, 1] < 1.3 * 11 / 12**0.5


def test_delay_of_seconds_does_not_reset_the_bounds() -> None:
    """Three responses that are late alike would, if only arrivals counted."""
    clock = ExchangeClock()
    for number in range(20):
        sent_ns = SWITCHED_ON_NS + (60_000 + 500 * number) * MS
        late_ns = 2_500 * MS if number > 10 else 0
        assert clock.add(instrument_ms(sent_ns + 5 * MS), sent_ns, sent_ns + 10 * MS + late_ns)
    assert not clock.resets
    assert clock.sigma_ns < 4 * MS


def test_power_cycle_resets_the_bounds() -> None:
    """Three exchanges that agree with each other; times before are not given."""
    clock, sent_ns = ExchangeClock(), 0
    for number in range(30):
        sent_ns = SWITCHED_ON_NS + (60_000 + 500 * number) * MS
        count_ms = instrument_ms(sent_ns + 5 * MS) - (50_000 if number >= 20 else 0)
        clock.add(count_ms, sent_ns, sent_ns + 10 * MS)
        if number in (20, 21):
            assert clock.inconsistent
            assert clock.timestamp(count_ms, sent_ns + 10 * MS) is None
    assert clock.resets == 1
    time = clock.at(instrument_ms(sent_ns) - 50_000)
    assert time is not None
    assert abs(time.host_ns - sent_ns) < 6 * MS


def test_single_contradiction_is_ignored() -> None:
    """A time that another program's reply has corrupted."""
    clock, sent_ns = ExchangeClock(), 0
    for number in range(20):
        sent_ns = SWITCHED_ON_NS + (60_000 + 500 * number) * MS
        clock.add(instrument_ms(sent_ns + 5 * MS) + (700 if number == 10 else 0), sent_ns, sent_ns + 10 * MS)
        assert clock.inconsistent == (number == 10)
    time = clock.at(instrument_ms(sent_ns))
    assert time is not None
    assert abs(time.host_ns - sent_ns) < 6 * MS


def test_distance_is_not_after_its_arrival() -> None:
    """Within the bound it is cut there; beyond, it contradicts."""
    clock, sent_ns = ExchangeClock(), 0
    for number in range(20):
        sent_ns = SWITCHED_ON_NS + (60_000 + 500 * number) * MS
        clock.add(instrument_ms(sent_ns + 2 * MS), sent_ns, sent_ns + 40 * MS)
    early = clock.timestamp(instrument_ms(sent_ns), sent_ns + 2 * MS)
    assert early is not None
    assert early.host_ns == sent_ns + 2 * MS
    assert clock.timestamp(instrument_ms(sent_ns), sent_ns - 100 * MS) is None
    assert clock.timestamp(instrument_ms(sent_ns), sent_ns + 4_000 * MS) is None


def test_gap_widens_the_uncertainty() -> None:
    """After ten minutes without exchanges the skew decides."""
    clock, sent_ns = ExchangeClock(), 0
    for number in range(60):
        sent_ns = SWITCHED_ON_NS + (60_000 + 500 * number) * MS
        clock.add(instrument_ms(sent_ns + 2 * MS), sent_ns, sent_ns + 4 * MS)
    now, later = clock.at(instrument_ms(sent_ns)), clock.at(instrument_ms(sent_ns + 600e9))
    assert now is not None
    assert later is not None
    assert abs(later.host_ns - sent_ns - 600e9) < later.bound_ns
    assert later.sigma_ns > 5 * now.sigma_ns


@pytest.mark.parametrize("slew_ppm", [100, 200, 300, 400, 500, -500])
def test_slew_of_the_host_clock_is_survived(slew_ppm: int) -> None:
    """No line fits the offset then: errors stay below a round trip, and after the window they are as stated again."""
    slewed_s, slew_s, window_s, max_round_trip_ns = 200.0, 100.0, 300.0, 14 * MS
    rng, clock = np.random.default_rng(4), ExchangeClock()

    def host_ns(true_s: float) -> int:
        return round(1e9 * true_s + 1e3 * slew_ppm * min(max(true_s - slewed_s, 0.0), slew_s))

    for true_s in np.arange(0.0, slewed_s + slew_s + window_s + 60.0, 0.5):
        request_s, response_s = rng.uniform(2e-3, max_round_trip_ns / 2e9, 2)
        count_ms = int((true_s + request_s) * 1000)
        clock.add(count_ms, host_ns(true_s), host_ns(true_s + request_s + response_s))
        time = clock.at(count_ms)
        if time is not None:
            error_ns = abs(time.host_ns - host_ns((count_ms + 0.5) / 1000))
            assert error_ns < max_round_trip_ns
            if not slewed_s < true_s < slewed_s + slew_s + window_s:
                assert error_ns <= min(time.bound_ns, 2.2 * time.sigma_ns)
