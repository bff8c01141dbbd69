from __future__ import annotations

import numpy as np
import pytest

from tsgt.timesync import Periodicity
from tsgt.timesync.periodicity import MAX_MEASUREMENTS, MIN_MEASUREMENTS

PERIOD_US = 400_000
PHASE_US = 123_456


def instants(count: int, *, period_us: float = PERIOD_US, phase_us: int = PHASE_US) -> list[int]:
    """Return the times of an instrument's measurements."""
    return [round(phase_us + k * period_us) for k in range(count)]


def estimate(times_us: list[int]) -> Periodicity:
    """Estimate the period from all times."""
    periodicity = Periodicity()
    for time_us in times_us:
        periodicity.add(time_us)
    return periodicity


def phase_error_us(periodicity: Periodicity, *, phase_us: float = PHASE_US) -> float:
    """Return the phase error against :func:`instants`."""
    assert periodicity.period is not None
    return (periodicity.period.phase_us - phase_us + PERIOD_US / 2) % PERIOD_US - PERIOD_US / 2


def test_regular_measurements_give_period_and_phase() -> None:
    """Six measurements suffice."""
    periodicity = estimate(instants(MIN_MEASUREMENTS))
    assert periodicity.period is not None
    assert periodicity.period.period_us == pytest.approx(PERIOD_US)
    assert phase_error_us(periodicity) == pytest.approx(0, abs=1)
    assert periodicity.period.jitter_us == pytest.approx(0, abs=1)
    assert periodicity.newest_us == PHASE_US + 5 * PERIOD_US


def test_few_measurements_give_no_period() -> None:
    """Five measurements do not suffice."""
    assert Periodicity().period is None
    assert Periodicity().newest_us is None
    assert estimate(instants(MIN_MEASUREMENTS - 1)).period is None


def test_lost_measurements_do_not_change_the_period() -> None:
    """With 40 % lost the period is exact, if two neighbours arrive now and then."""
    generator = np.random.default_rng(1)
    periodicity = estimate([time for time in instants(60) if generator.random() < 0.6])
    assert periodicity.period is not None
    assert periodicity.period.period_us == pytest.approx(PERIOD_US, abs=1)
    assert phase_error_us(periodicity) == pytest.approx(0, abs=1)


def test_order_and_repetition_do_not_matter() -> None:
    """Measurements may arrive in any order; far older ones are ignored."""
    times = instants(20)
    periodicity = estimate([*times[::2], *times[1::2], *times, times[0] - 60_000_000])
    assert periodicity.period is not None
    assert periodicity.period.period_us == pytest.approx(PERIOD_US, abs=1)
    assert phase_error_us(periodicity) == pytest.approx(0, abs=1)


def test_jitter_is_averaged_and_estimated() -> None:
    """With 5 ms of jitter the phase error is below 5 ms, and the estimated jitter about 5 ms."""
    for seed in range(20):
        generator = np.random.default_rng(seed)
        periodicity = estimate(
            [time + round(generator.normal(0, 5000)) for time in instants(MAX_MEASUREMENTS)]
        )
        assert periodicity.period is not None
        assert abs(phase_error_us(periodicity)) < 5000
        assert 2000 < periodicity.period.jitter_us < 8000


def test_outlier_is_rejected() -> None:
    """A single late measurement does not change the phase."""
    times = instants(MAX_MEASUREMENTS)
    times[-3] += 150_000
    periodicity = estimate(times)
    assert phase_error_us(periodicity) == pytest.approx(0, abs=1)


def test_drift_is_followed() -> None:
    """The phase of a clock with 200 ppm skew is within 50 us after any time."""
    times = instants(2000, period_us=PERIOD_US * (1 + 200e-6))
    periodicity = estimate(times)
    assert phase_error_us(periodicity, phase_us=times[-1]) == pytest.approx(0, abs=50)


def test_long_gap_resets_the_estimate() -> None:
    """The instrument may have been restarted."""
    after = [time + 60_000_000 + 170_000 for time in instants(MIN_MEASUREMENTS)]
    periodicity = estimate(instants(20) + after[:-1])
    assert periodicity.period is None
    periodicity.add(after[-1])
    assert phase_error_us(periodicity, phase_us=PHASE_US + 170_000) == pytest.approx(0, abs=1)


def test_phase_change_is_followed_within_ten_seconds() -> None:
    """A phase changes when the prism was lost for a moment."""
    periodicity = estimate(
        instants(40) + [time + 40 * PERIOD_US + 130_000 for time in instants(MAX_MEASUREMENTS)]
    )
    assert phase_error_us(periodicity, phase_us=PHASE_US + 130_000) == pytest.approx(0, abs=1000)


def test_random_measurements_have_no_period() -> None:
    """An aperiodic instrument has no period."""
    generator = np.random.default_rng(3)
    times, time_us = [], 0
    for _ in range(100):
        time_us += int(generator.integers(50_000, 2_000_000))
        times.append(time_us)
    assert estimate(times).period is None
