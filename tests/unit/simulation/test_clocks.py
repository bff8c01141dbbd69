"""The virtual clock: the loop's time, and sleeps that reach their instant."""

from __future__ import annotations

import time

from tsgt.simulation.clocks import VirtualClock

START_NS = 1_700_000_000_123_456_789


async def test_an_hour_passes_at_once() -> None:
    """Sleeping an hour moves both clocks by an hour and costs no real time."""
    clock = VirtualClock(START_NS)
    began_s = time.monotonic()
    await clock.sleep_until(3_600_000_000_000)
    assert clock.monotonic_ns() >= 3_600_000_000_000
    assert clock.realtime_ns() - clock.monotonic_ns() == START_NS
    assert time.monotonic() - began_s < 1.0


async def test_a_sleep_is_never_too_short() -> None:
    """The instant asked for has been reached on return, odd nanoseconds included, and not long ago."""
    clock = VirtualClock(START_NS)
    for instant_ns in (1, 1_000_001, 1_234_567_891, 77_777_777_777):
        await clock.sleep_until(instant_ns)
        assert 0 <= clock.monotonic_ns() - instant_ns < 10_000


async def test_the_past_is_reached_already() -> None:
    """Waiting for an instant that has passed takes no time."""
    clock = VirtualClock(START_NS)
    await clock.sleep_until(5_000_000_000)
    now_ns = clock.monotonic_ns()
    await clock.sleep_until(1_000_000_000)
    assert clock.monotonic_ns() == now_ns
