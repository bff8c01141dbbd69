from __future__ import annotations

import numpy as np
import pytest

from tsgt.timesync import Periodicity
from tsgt.timesync.periodicity import MAX_MEASUREMENTS, MIN_MEASUREMENTS

PERIOD_US = 400_000
PHASE_US = 123_456


def instants(count: int, *, period_us: float = PERIOD_US, phase_us: int = PHASE_US) -> list[int]:
    """When an instrument measures."""
    return [round(phase_us + k * period_us) for k in range(count)]


def listened(times_us: list[int]) -> Periodicity:
    """Give all to a new periodicity."""
    periodicity = Periodicity()
    for time_us in times_us:
        periodicity.add(time_us)
    return periodicity


def off_us(periodicity: Periodicity, *, phase_us: float = PHASE_US) -> float:
    """By how much its beat is off that of :func:`instants`."""
    assert periodicity.period is not None
    return (periodicity.period.phase_us - phase_us + PERIOD_US / 2) % PERIOD_US - PERIOD_US / 2


def test_even_measurements_tell_period_and_phase() -> None:
    """Six are enough."""
    periodicity = listened(instants(MIN_MEASUREMENTS))
    assert periodicity.period is not None
    assert periodicity.period.period_us == pytest.approx(PERIOD_US)
    assert off_us(periodicity) == pytest.approx(0, abs=1)
    assert periodicity.period.jitter_us == pytest.approx(0, abs=1)
    assert periodicity.newest_us == PHASE_US + 5 * PERIOD_US


def test_few_measurements_tell_nothing() -> None:
    """Neither none nor five."""
    assert Periodicity().period is None
    assert Periodicity().newest_us is None
    assert listened(instants(MIN_MEASUREMENTS - 1)).period is None


def test_lost_measurements_do_not_disturb() -> None:
    """Every third one is enough to tell the interval, if two neighbours come now and then."""
    generator = np.random.default_rng(1)
    periodicity = listened([time for time in instants(60) if generator.random() < 0.6])
    assert periodicity.period is not None
    assert periodicity.period.period_us == pytest.approx(PERIOD_US, abs=1)
    assert off_us(periodicity) == pytest.approx(0, abs=1)


def test_late_measurements_and_repeated_ones_change_nothing() -> None:
    """They may come in any order; far older ones are left out."""
    times = instants(20)
    periodicity = listened([*times[::2], *times[1::2], *times, times[0] - 60_000_000])
    assert periodicity.period is not None
    assert periodicity.period.period_us == pytest.approx(PERIOD_US, abs=1)
    assert off_us(periodicity) == pytest.approx(0, abs=1)


def test_noise_is_averaged_and_told() -> None:
    """With 5 ms of it the phase is good to 5 ms, and the spread is about 5 ms."""
    for seed in range(20):
        generator = np.random.default_rng(seed)
        periodicity = listened(
            [time + round(generator.normal(0, 5000)) for time in instants(MAX_MEASUREMENTS)]
        )
        assert periodicity.period is not None
        assert abs(off_us(periodicity)) < 5000
        assert 2000 < periodicity.period.jitter_us < 8000


def test_one_that_lies_far_off_is_left_out() -> None:
    """As when an instrument takes longer once."""
    times = instants(MAX_MEASUREMENTS)
    times[-3] += 150_000
    periodicity = listened(times)
    assert off_us(periodicity) == pytest.approx(0, abs=1)


def test_drift_is_followed() -> None:
    """A clock that runs 200 ppm fast is met to 50 us after any time."""
    times = instants(2000, period_us=PERIOD_US * (1 + 200e-6))
    periodicity = listened(times)
    assert off_us(periodicity, phase_us=times[-1]) == pytest.approx(0, abs=50)


def test_after_a_pause_everything_is_learnt_anew() -> None:
    """The instrument may have been switched off and on."""
    after = [time + 60_000_000 + 170_000 for time in instants(MIN_MEASUREMENTS)]
    periodicity = listened(instants(20) + after[:-1])
    assert periodicity.period is None
    periodicity.add(after[-1])
    assert off_us(periodicity, phase_us=PHASE_US + 170_000) == pytest.approx(0, abs=1)


def test_another_phase_is_learnt_within_ten_seconds() -> None:
    """As when a prism was lost for a moment."""
    periodicity = listened(
        instants(40) + [time + 40 * PERIOD_US + 130_000 for time in instants(MAX_MEASUREMENTS)]
    )
    assert off_us(periodicity, phase_us=PHASE_US + 130_000) == pytest.approx(0, abs=1000)


def test_measurements_at_random_have_no_beat() -> None:
    """An instrument that measures when it likes."""
    generator = np.random.default_rng(3)
    times, time_us = [], 0
    for _ in range(100):
        time_us += int(generator.integers(50_000, 2_000_000))
        times.append(time_us)
    assert listened(times).period is None
