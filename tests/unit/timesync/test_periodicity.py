from __future__ import annotations

import numpy as np
import pytest

from tsgt.timesync import Rhythm
from tsgt.timesync.periodicity import LEAST, MOST

PERIOD_US = 400_000
PHASE_US = 123_456


def instants(count: int, *, period_us: float = PERIOD_US, phase_us: int = PHASE_US) -> list[int]:
    """When an instrument measures."""
    return [round(phase_us + k * period_us) for k in range(count)]


def listened(times_us: list[int]) -> Rhythm:
    """Give all to a new rhythm."""
    rhythm = Rhythm()
    for time_us in times_us:
        rhythm.add(time_us)
    return rhythm


def off_us(rhythm: Rhythm, *, phase_us: float = PHASE_US) -> float:
    """By how much its beat is off that of :func:`instants`."""
    assert rhythm.beat is not None
    return (rhythm.beat.phase_us - phase_us + PERIOD_US / 2) % PERIOD_US - PERIOD_US / 2


def test_even_measurements_tell_period_and_phase() -> None:
    """Six are enough."""
    rhythm = listened(instants(LEAST))
    assert rhythm.beat is not None
    assert rhythm.beat.period_us == pytest.approx(PERIOD_US)
    assert off_us(rhythm) == pytest.approx(0, abs=1)
    assert rhythm.beat.spread_us == pytest.approx(0, abs=1)
    assert rhythm.newest_us == PHASE_US + 5 * PERIOD_US


def test_few_measurements_tell_nothing() -> None:
    """Neither none nor five."""
    assert Rhythm().beat is None
    assert Rhythm().newest_us is None
    assert listened(instants(LEAST - 1)).beat is None


def test_lost_measurements_do_not_disturb() -> None:
    """Every third one is enough to tell the interval, if two neighbours come now and then."""
    generator = np.random.default_rng(1)
    rhythm = listened([time for time in instants(60) if generator.random() < 0.6])
    assert rhythm.beat is not None
    assert rhythm.beat.period_us == pytest.approx(PERIOD_US, abs=1)
    assert off_us(rhythm) == pytest.approx(0, abs=1)


def test_late_measurements_and_repeated_ones_change_nothing() -> None:
    """They may come in any order; far older ones are left out."""
    times = instants(20)
    rhythm = listened([*times[::2], *times[1::2], *times, times[0] - 60_000_000])
    assert rhythm.beat is not None
    assert rhythm.beat.period_us == pytest.approx(PERIOD_US, abs=1)
    assert off_us(rhythm) == pytest.approx(0, abs=1)


def test_noise_is_averaged_and_told() -> None:
    """With 5 ms of it the phase is good to 5 ms, and the spread is about 5 ms."""
    for seed in range(20):
        generator = np.random.default_rng(seed)
        rhythm = listened([time + round(generator.normal(0, 5000)) for time in instants(MOST)])
        assert rhythm.beat is not None
        assert abs(off_us(rhythm)) < 5000
        assert 2000 < rhythm.beat.spread_us < 8000


def test_one_that_lies_far_off_is_left_out() -> None:
    """As when an instrument takes longer once."""
    times = instants(MOST)
    times[-3] += 150_000
    rhythm = listened(times)
    assert off_us(rhythm) == pytest.approx(0, abs=1)


def test_drift_is_followed() -> None:
    """A clock that runs 200 ppm fast is met to 50 us after any time."""
    times = instants(2000, period_us=PERIOD_US * (1 + 200e-6))
    rhythm = listened(times)
    assert off_us(rhythm, phase_us=times[-1]) == pytest.approx(0, abs=50)


def test_after_a_pause_everything_is_learnt_anew() -> None:
    """The instrument may have been switched off and on."""
    after = [time + 60_000_000 + 170_000 for time in instants(LEAST)]
    rhythm = listened(instants(20) + after[:-1])
    assert rhythm.beat is None
    rhythm.add(after[-1])
    assert off_us(rhythm, phase_us=PHASE_US + 170_000) == pytest.approx(0, abs=1)


def test_another_phase_is_learnt_within_ten_seconds() -> None:
    """As when a prism was lost for a moment."""
    rhythm = listened(instants(40) + [time + 40 * PERIOD_US + 130_000 for time in instants(MOST)])
    assert off_us(rhythm, phase_us=PHASE_US + 130_000) == pytest.approx(0, abs=1000)


def test_measurements_at_random_have_no_beat() -> None:
    """An instrument that measures when it likes."""
    generator = np.random.default_rng(3)
    times, time_us = [], 0
    for _ in range(100):
        time_us += int(generator.integers(50_000, 2_000_000))
        times.append(time_us)
    assert listened(times).beat is None
