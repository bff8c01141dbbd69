"""The instrument's time on the host's clock."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsgt.timesync import InstrumentClock
from tsgt.timesync.instrument_clock import MIN_SAMPLES

MS = 1_000_000
OFFSET_NS = 77_000_000_000_000
FASTEST_MS = 20


def arrived_ns(instrument_ms: float, late_ms: float = 0.0, rate: float = 0.0) -> int:
    """Return the arrival of a response with that instrument time."""
    return OFFSET_NS + round((instrument_ms * (1 + rate) + FASTEST_MS + late_ms) * MS)


def initialised_clock(samples: int = 200, rate: float = 0.0, start_ms: int = 5_000_000) -> InstrumentClock:
    """Return a clock with samples every 400 ms, every fourth one with the minimum delay."""
    clock = InstrumentClock()
    for number in range(samples):
        ms = start_ms + 400 * number
        assert clock.add(ms, arrived_ns(ms, 10.0 * (number % 4), rate))
    return clock


def test_no_time_before_initialisation() -> None:
    """A few responses may all be late."""
    clock = InstrumentClock()
    for number in range(MIN_SAMPLES):
        assert clock.at(1000) is None
        clock.add(1000 + 100 * number, arrived_ns(1000 + 100 * number))
    assert clock.initialised
    time = clock.at(1000)
    assert time is not None
    assert 0 <= time.host_ns - arrived_ns(1000) < MS  # it was taken within the stated ms


def test_fastest_responses_define_the_envelope() -> None:
    """Late responses do not change the envelope."""
    time = initialised_clock().at(5_079_600)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(5_079_600)) < MS / 2
    assert time.bound_ns < 5 * MS


@pytest.mark.parametrize("rate", [-200e-6, -20e-6, 20e-6, 200e-6])
def test_skew_is_estimated(rate: float) -> None:
    """After some minutes times follow the skew."""
    clock = initialised_clock(1000, rate)
    time = clock.at(5_399_600)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(5_399_600, rate=rate)) < MS


@pytest.mark.parametrize("start_ms", [300, 4_000_000, 2_000_000_000])
def test_power_cycle_resets_the_clock(start_ms: int) -> None:
    """Three samples that agree with a new count reset the fit; old times are void."""
    clock = initialised_clock()
    results = [
        clock.add(start_ms + 100 * n, arrived_ns(5_200_000 + 100 * n, late_ms=7 * (n % 8)))
        for n in range(8 * MIN_SAMPLES)
    ]
    assert results.count(False) == 1
    assert clock.initialised
    time = clock.at(start_ms)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(5_200_000)) < MS


def test_wrap_of_the_count_resets_the_clock() -> None:
    """After 24.8 days a 32-bit count becomes negative."""
    start_ms = 2**31 - 400 * 100
    clock = InstrumentClock()
    errors_ns, outside = [], 0
    for number in range(300):
        ms = start_ms + 400 * number
        wrapped = ms - 2**32 if ms >= 2**31 else ms
        clock.add(wrapped, arrived_ns(ms, 10.0 * (number % 4)))
        time = clock.timestamp(wrapped, arrived_ns(ms, 50.0))
        if time is not None:
            errors_ns.append(abs(time.host_ns - arrived_ns(ms)))
            outside += errors_ns[-1] > time.bound_ns
    assert len(errors_ns) > 300 - 2 * MIN_SAMPLES - 2
    assert outside == 0
    assert max(errors_ns[-150:]) < MS


def test_corrupted_time_is_inconsistent() -> None:
    """A time with a wrong digit gets no timestamp and does not change the fit."""
    clock = initialised_clock()
    before = clock.at(5_080_000)
    for wrong_ms in (-30_000, 90, 700, 5_000, 40_000_000):
        assert clock.timestamp(5_080_000 + wrong_ms, arrived_ns(5_080_000, 5.0)) is None
        for number in range(40):
            clock.add(5_080_000 + 400 * number, arrived_ns(5_080_000 + 400 * number, 10.0))
    after = clock.at(5_080_000)
    assert before is not None
    assert after is not None
    assert abs(after.host_ns - before.host_ns) < MS


@pytest.mark.parametrize("wrong_ms", [-5000, 60, 400, 70_000])
@pytest.mark.parametrize("which", [0, 3, 7])
def test_corrupted_time_during_initialisation_is_rejected(wrong_ms: int, which: int) -> None:
    """Before there is an envelope, the other samples reject an outlier."""
    clock = InstrumentClock()
    for number in range(MIN_SAMPLES + 2):
        ms = 60_000 + 50 * number
        clock.add(ms + (wrong_ms if number == which else 0), arrived_ns(ms, 3.0 * (number % 4)))
    time = clock.at(60_000)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(60_000)) < 10 * MS


def test_faster_response_during_initialisation_counts() -> None:
    """Of the first eight one is fastest, and the others happen to be alike: it is no corrupted one, its exchange was as fast."""
    clock = InstrumentClock()
    for number, late_ms in enumerate([15.0, 15.2, 14.9, 7.9, 31.4, 17.8, 15.7, 16.1]):
        ms = 1000 + 50 * number
        clock.add(ms, arrived_ns(ms, late_ms), round((22.0 + late_ms) * MS))
    time = clock.at(1400)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(1400)) < 3 * time.sigma_ns


@pytest.mark.parametrize("samples", [MIN_SAMPLES, 12, 24])
def test_first_times_are_as_uncertain_as_they_say(samples: int) -> None:
    """Over 300 starts of an instrument that responds within 20 to 60 ms; the spread of its delays is not known before."""
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(300):
        clock = InstrumentClock()
        for number in range(samples):
            ms = 1000.3 + 60 * number
            late_ms = float(rng.uniform(0, 40))
            clock.add(int(ms), arrived_ns(ms, late_ms), round((22 + late_ms + rng.normal(0, 0.5)) * MS))
        time = clock.at(int(ms))
        assert time is not None
        errors.append((time.host_ns - arrived_ns(ms)) / time.sigma_ns)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.2
    assert np.count_nonzero(np.abs(errors) > 6) <= 2


def test_faster_response_lowers_the_envelope_at_once() -> None:
    """Eight responses happened to be alike; the next one is far below, and its exchange took as much less."""
    clock = InstrumentClock()
    for number in range(MIN_SAMPLES):
        ms = 1000 + 50 * number
        clock.add(ms, arrived_ns(ms, 15.0 + 0.1 * number), round((37.0 + 0.1 * number) * MS))
    inconsistent = []
    for ms, took_ns in (
        (1500, 36_000_000),
        (1600, 22_500_000),
    ):  # the first as slow as the others: its time is corrupted
        clock.add(ms, arrived_ns(ms, 0.5), took_ns)
        inconsistent.append(clock.inconsistent)
    assert inconsistent == [True, False]
    time = clock.at(1600)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(1600)) < 3 * MS


@pytest.mark.parametrize("before", range(1, MIN_SAMPLES))
def test_power_cycle_during_initialisation(before: int) -> None:
    """The samples after the power cycle define the fit, however many came before."""
    clock = InstrumentClock()
    for number in range(before):
        clock.add(50_000_000 + 50 * number, arrived_ns(0, 50.0 * number))
    for number in range(3 * MIN_SAMPLES):
        ms = 5000 + 50 * number
        clock.add(ms, arrived_ns(ms, 3.0 * (number % 4)))
    time = clock.at(5000)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(5000)) < 10 * MS


def test_faster_responses_lower_the_envelope() -> None:
    """A smaller minimum delay, as from another baud rate, lowers the envelope without a reset."""
    clock = initialised_clock()
    for number in range(200):
        ms = 5_080_000 + 400 * number
        assert clock.add(ms, arrived_ns(ms, -12.0 + number % 3))
    time = clock.at(5_160_000)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(5_160_000, -12.0)) < MS


def test_gap_is_extrapolated() -> None:
    """After ten minutes without a response the skew extrapolates, with a larger bound."""
    clock = initialised_clock(1000, 20e-6)
    ms = 5_400_000 + 600_000
    time = clock.timestamp(ms, arrived_ns(ms, 35.0, 20e-6))
    before = clock.at(5_399_600)
    assert time is not None
    assert before is not None
    assert abs(time.host_ns - arrived_ns(ms, rate=20e-6)) < time.bound_ns
    assert before.bound_ns < time.bound_ns < 40 * MS


def test_stale_response_has_no_time() -> None:
    """A delay above two seconds is no delay."""
    clock = initialised_clock()
    assert clock.timestamp(5_080_000, arrived_ns(5_080_000, 1_900.0)) is not None
    assert clock.timestamp(5_080_400, arrived_ns(5_080_400, 2_100.0)) is None


class Results(NamedTuple):
    """Times and arrivals of 300 responses, and the number of times outside their bound."""

    times_ns: list[int]
    arrived_ns: list[int]
    outside: int


def run_responses(random: np.random.Generator, rate_ppm: float, spread_ms: float, period_ms: int) -> Results:
    """Run a clock on responses with delays uniform up to ``spread_ms``."""
    clock = InstrumentClock()
    results = Results([], [], 0)
    for number in range(300):
        true_ms = 1_000_000 + number * period_ms + random.normal(0, 4)
        arrived = arrived_ns(true_ms, random.uniform(0, spread_ms), rate_ppm * 1e-6)
        clock.add(int(true_ms), arrived)
        time = None if clock.inconsistent else clock.timestamp(int(true_ms), arrived)
        if time is None:
            continue
        results.times_ns.append(time.host_ns)
        results.arrived_ns.append(arrived)
        beyond = abs(time.host_ns - arrived_ns(true_ms, rate=rate_ppm * 1e-6)) > time.bound_ns
        results = results._replace(outside=results.outside + beyond)
    return results


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    rate_ppm=st.floats(-100, 100),
    spread_ms=st.floats(0.1, 100),
    period_ms=st.sampled_from([50, 400, 1000]),
)
@pytest.mark.slow
def test_times_are_in_order_and_never_after_the_arrival(
    seed: int, rate_ppm: float, spread_ms: float, period_ms: int
) -> None:
    """Nearly every response has a time."""
    results = run_responses(np.random.default_rng(seed), rate_ppm, spread_ms, period_ms)
    assert len(results.times_ns) >= 280
    assert all(before < after for before, after in pairwise(results.times_ns))
    assert all(time <= arrived for time, arrived in zip(results.times_ns, results.arrived_ns, strict=True))


@pytest.mark.slow
def test_bound_contains_nearly_all_times() -> None:
    """Over many runs at most 1 % exceed it; in a single run without early fast responses dozens may."""
    random = np.random.default_rng(5)
    outside = sum(
        run_responses(random, random.uniform(-100, 100), random.uniform(0.1, 100), period_ms).outside
        for period_ms in 20 * [50, 400, 1000]
    )
    assert outside <= 60 * 300 // 100


def slowing_errors_ms(before: float = 0.0, start_s: float = 0.0) -> list[float]:
    """Return errors of times in ms while an instrument becomes four times as slow within two minutes, after ten seconds.

    ``before``: share of the delay that comes before the measurement.
    """
    random = np.random.default_rng(3)
    clock, errors, at_s = InstrumentClock(), [], start_s
    while at_s < 130.0:
        ms = 5_000_000 + 1000 * at_s
        processing_ms = random.uniform(FASTEST_MS, 3 * FASTEST_MS) * 4.0 ** max((at_s - 10.0) / 120.0, 0.0)
        late_ms = (1 - before) * (processing_ms - FASTEST_MS)
        clock.add(int(ms), arrived_ns(ms, late_ms), round((processing_ms + 2.0 + random.normal(0, 0.3)) * MS))
        if (time := clock.at(int(ms))) is not None:
            errors.append((time.host_ns - arrived_ns(int(ms) + 0.5)) / MS)
        at_s += 0.15 if at_s < 6.0 else 0.5
    return errors


@pytest.mark.parametrize("before", [0.0, 0.5, 1.0])
def test_slower_responses_are_no_skew(before: float) -> None:
    """The durations of their exchanges show it, whichever share of them comes before the measurement."""
    assert max(map(abs, slowing_errors_ms(before)[60:])) < 1.5


def test_durations_that_explain_no_delay_are_left_out() -> None:
    """Requests and responses are late by chance, each on its own: times are those without durations."""
    random = np.random.default_rng(1)
    timed, untimed = InstrumentClock(), InstrumentClock()
    for number in range(400):
        ms = 5_000_000 + 500 * number
        requested_late_ms, late_ms = random.uniform(0.0, 20.0), random.uniform(0.0, 40.0)
        timed.add(ms, arrived_ns(ms, late_ms), round((FASTEST_MS + requested_late_ms + late_ms) * MS))
        untimed.add(ms, arrived_ns(ms, late_ms))
    time, expected = timed.at(5_200_000), untimed.at(5_200_000)
    assert time is not None
    assert expected is not None
    assert time == pytest.approx(expected, abs=10_000)


def test_clock_fitted_to_slow_responses_is_late() -> None:
    """Nothing shows that they are slow; times are late by as much as the fastest one is slower, and not by more."""
    errors = slowing_errors_ms(start_s=70.0)  # twice as slow in the beginning
    assert all(FASTEST_MS - 5.0 < each < FASTEST_MS + 25.0 for each in errors[30:])


def test_clock_follows_responses_that_stay_slower() -> None:
    """Without durations of exchanges, as behind a bridge: when the window has no others any more, they are the usual ones."""
    clock = InstrumentClock()
    for number in range(1000):
        ms = 5_000_000 + 500 * number
        late_ms = 10.0 * (number % 4) + (40.0 if number > 200 else 0.0)
        assert clock.add(ms, arrived_ns(ms, late_ms))
    time = clock.at(5_500_000)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(5_500_000, 40.0)) < MS


def test_first_times_after_a_power_cycle_are_known() -> None:
    """All responses after it happen to be late, which the duration of their exchanges shows."""
    random = np.random.default_rng(2)
    clock = InstrumentClock()
    for number in range(60 + 3 + MIN_SAMPLES):
        cycled = number >= 60
        ms = 200_000.3 + 500 * number
        stated_ms = int(ms) - 190_000 * cycled
        late_ms = random.uniform(15.0, 40.0) if cycled else random.uniform(0.0, 40.0)
        clock.add(stated_ms, arrived_ns(ms, late_ms), round((22.0 + late_ms) * MS))
    assert clock.resets == 1
    time = clock.at(stated_ms)
    assert time is not None
    assert abs(time.host_ns - arrived_ns(ms)) < 2 * MS
    assert time.sigma_ns < MS
