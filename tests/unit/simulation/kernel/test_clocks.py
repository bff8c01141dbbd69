"""Virtual and drifting clocks: their time, and sleeps that end at the right instant."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.simulation.kernel import DriftingClock, VirtualClock, drift_ramp

START_NS = 1_700_000_000_123_456_789
HOUR_NS = 3_600_000_000_000

instants_ns = st.integers(0, 1000 * HOUR_NS)
drifts_ppm = st.floats(-1000, 1000)


async def test_sleep_takes_no_real_time() -> None:
    """Sleeping an hour advances both clocks by an hour."""
    clock = VirtualClock(START_NS)
    start_s = time.monotonic()
    await clock.sleep_until(3_600_000_000_000)
    assert clock.monotonic_ns() >= 3_600_000_000_000
    assert clock.realtime_ns() - clock.monotonic_ns() == START_NS
    assert time.monotonic() - start_s < 1.0


async def test_sleep_is_never_too_short() -> None:
    """The instant has been reached on return, odd nanoseconds included, and not long ago."""
    clock = VirtualClock(START_NS)
    for instant_ns in (1, 1_000_001, 1_234_567_891, 77_777_777_777):
        await clock.sleep_until(instant_ns)
        assert 0 <= clock.monotonic_ns() - instant_ns < 10_000


async def test_sleep_until_the_past_returns_at_once() -> None:
    """Waiting for an instant that has passed takes no time."""
    clock = VirtualClock(START_NS)
    await clock.sleep_until(5_000_000_000)
    now_ns = clock.monotonic_ns()
    await clock.sleep_until(1_000_000_000)
    assert clock.monotonic_ns() == now_ns


async def test_drifting_clock_gains() -> None:
    """After an hour a clock with 10 ppm is 36 ms further ahead, monotonic and Unix time alike."""
    true = VirtualClock(START_NS)
    clock = DriftingClock(true, offset_ns=-5_000_000_000, drift_ppm=10.0)
    await true.sleep_until(HOUR_NS)
    assert clock.monotonic_ns() - true.monotonic_ns() == 36_000_000
    assert clock.realtime_ns() - true.realtime_ns() == -5_000_000_000 + 36_000_000


async def test_sleep_follows_the_drifting_clock() -> None:
    """A sleep ends when the clock itself reaches the instant."""
    for drift_ppm in (-200.0, 0.0, 200.0):
        clock = DriftingClock(VirtualClock(START_NS), drift_ppm=drift_ppm)
        instant_ns = clock.monotonic_ns() + HOUR_NS
        await clock.sleep_until(instant_ns)
        assert 0 <= clock.monotonic_ns() - instant_ns < 10_000


async def test_step_changes_the_unix_clock_only() -> None:
    """CLOCK_MONOTONIC is unaffected."""
    clock = DriftingClock(VirtualClock(START_NS))
    before_ns = clock.monotonic_ns()
    clock.step(60_000_000_000)
    assert clock.monotonic_ns() == before_ns
    assert clock.realtime_ns() == START_NS + before_ns + 60_000_000_000


def test_drift_changes() -> None:
    """Each segment runs at its own rate from the end of the previous one."""
    warming = [(2 * HOUR_NS, -10.0), (HOUR_NS, 20.0)]
    clock = DriftingClock(VirtualClock(START_NS), drift_ppm=0.0, drift_changes=warming)
    gained_ms = [(clock.local_ns(n * HOUR_NS) - n * HOUR_NS) / 1e6 for n in range(4)]
    assert gained_ms == [0.0, 0.0, 72.0, 36.0]


def test_drift_ramp() -> None:
    """From 5 ppm by 6 ppm a minute, ten minutes up and ten down: the gain is the area below the ramp."""
    minute_ns = 60_000_000_000
    clock = DriftingClock(VirtualClock(START_NS), drift_changes=drift_ramp(5.0, 6.0, 20 * minute_ns))
    gained_us = [(clock.local_ns(n * minute_ns) - n * minute_ns) / 1e3 for n in (1, 10, 20)]
    assert gained_us == pytest.approx([60 * 8, 600 * 35, 1200 * 35], abs=0.01)


@given(instants_ns, drifts_ppm, st.lists(st.tuples(instants_ns, drifts_ppm), max_size=3))
def test_conversion_round_trip(true_ns: int, drift_ppm: float, steps: list[tuple[int, float]]) -> None:
    """The reading at an instant converts back to the first instant with that reading."""
    clock = DriftingClock(VirtualClock(START_NS), drift_ppm=drift_ppm, drift_changes=steps)
    local_ns = clock.local_ns(true_ns)
    found_ns = clock.true_ns(local_ns)
    assert clock.local_ns(found_ns) == local_ns
    assert clock.local_ns(found_ns - 1) < local_ns
    assert 0 <= true_ns - found_ns <= 1
