"""A station that was without radio contact for hours, in the loop of master and stations."""

from __future__ import annotations

from random import Random

import pytest
from harness.radio.scripted_stations import KEY, TIMING
from harness.radio.superframe_loop import MS, SuperframeLoop

from tsgt.radio.superframe.wire import Authenticator

HOURS = 1.0
STEP_NS = 600_000 * MS
"""The master runs on without hearing the station; a frame in ten minutes is enough for that."""
MIN_DRAIN_HZ = 5.0
"""Twice the rate at which the station measures on."""


@pytest.mark.slow
def test_backlog_of_hours_arrives_with_right_times() -> None:
    """All of it, while the other stations deliver, and faster than the station measures on."""
    loop = SuperframeLoop(TIMING, Authenticator(KEY), Random(1).getrandbits)  # noqa: S311 (a test has no secrets)
    for _ in range(60):
        loop.run_frame()
    station = loop.members[2]
    back_ns = loop.now_ns + round(HOURS * 3600e3) * MS
    while loop.now_ns < back_ns:
        loop.now_ns += STEP_NS
        for number in (1, 3):
            loop.members[number].next_ns = loop.now_ns
        loop.run_frame(missed_by=(2,))
    back_ns = loop.now_ns
    loop.run_frame()
    backlog = len(station.made_ns) - len(station.received)
    while loop.now_ns < back_ns + backlog / MIN_DRAIN_HZ * 1e9 and len(station.received) < len(
        station.made_ns
    ):
        loop.run_frame()
    assert backlog > 8900
    assert set(range(backlog)) <= station.received.keys()
    errors_ns = station.errors_ns()
    assert all(abs(errors_ns[number]) <= station.received[number].bound_ns for number in errors_ns)
