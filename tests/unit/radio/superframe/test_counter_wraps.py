"""Counters of the radio protocol where they wrap or run out: nothing is lost, and no timestamp exceeds its bound.

The master was started long before, or its frame counter is set, so that no test runs for days.
"""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import pytest
from harness.radio.scripted_stations import KEY, TIMING
from harness.radio.superframe_loop import MS, START_NS, SuperframeLoop

from tsgt.radio.superframe.master import MAX_FRAMES_PER_SESSION
from tsgt.radio.superframe.wire import SESSION_TIME_BITS, Authenticator

if TYPE_CHECKING:
    from harness.radio.superframe_loop import LoopStation

SESSION_TIME_WRAP_NS = 1000 << SESSION_TIME_BITS
BEFORE_NS = 20_000 * MS


def loop_before_wrap() -> SuperframeLoop:
    """Return a loop whose session time wraps in twenty seconds; the stations start now."""
    loop = SuperframeLoop(TIMING, Authenticator(KEY), Random(1).getrandbits)  # noqa: S311 (a test has no secrets)
    loop.now_ns = START_NS + SESSION_TIME_WRAP_NS - BEFORE_NS
    for member in loop.members.values():
        member.next_ns += SESSION_TIME_WRAP_NS - BEFORE_NS
    return loop


def session_time_ns(loop: SuperframeLoop) -> int:
    """Return the session time, before its reduction."""
    return loop.now_ns - START_NS


def undelivered(member: LoopStation) -> list[int]:
    """Return the measurements that the master lacks, except the newest, which may still wait for a slot."""
    return [number for number in list(member.made_ns)[:-8] if number not in member.received]


def timestamp_violations(member: LoopStation) -> dict[int, int]:
    """Return by how much timestamp errors exceed their bounds, by sequence number."""
    beyond = {k: abs(off) - member.received[k].bound_ns for k, off in member.errors_ns().items()}
    return {number: ns for number, ns in beyond.items() if ns > 0}


def assert_sound(loop: SuperframeLoop) -> None:
    """All measurements arrived, with right times."""
    for member in loop.members.values():
        assert undelivered(member) == []
        assert timestamp_violations(member) == {}


def test_session_time_wraps_after_12_days() -> None:
    """Stations that have the time before the wrap have it after it."""
    loop = loop_before_wrap()
    while session_time_ns(loop) < SESSION_TIME_WRAP_NS + 3 * BEFORE_NS:
        loop.run_frame()
    assert_sound(loop)


@pytest.mark.parametrize("gone_ns", [4_000 * MS, 15_000 * MS, 30_000 * MS])
@pytest.mark.slow
def test_backlog_from_before_the_wrap_arrives_after_it(gone_ns: int) -> None:
    """A station without radio contact across the wrap delivers what it measured on both sides of it."""
    loop = loop_before_wrap()
    half_ns = gone_ns // 2
    while session_time_ns(loop) < SESSION_TIME_WRAP_NS + 5 * BEFORE_NS:
        away = abs(session_time_ns(loop) - SESSION_TIME_WRAP_NS) < half_ns
        loop.run_frame(missed_by=(2,) if away else ())
    assert_sound(loop)


def test_station_joins_at_the_wrap() -> None:
    """Its first full times are from both sides of the wrap."""
    loop = loop_before_wrap()
    while session_time_ns(loop) < SESSION_TIME_WRAP_NS + 3 * BEFORE_NS:
        early = session_time_ns(loop) < SESSION_TIME_WRAP_NS - 2_000 * MS
        loop.run_frame(missed_by=(3,) if early else ())
    assert_sound(loop)


def test_new_session_when_the_frame_counter_runs_out() -> None:
    """After 77 days at 0.4 s a new session begins; the stations join it, nothing is lost or late beyond its bound."""
    loop = SuperframeLoop(TIMING, Authenticator(KEY), Random(1).getrandbits)  # noqa: S311 (a test has no secrets)
    loop.master.counter = MAX_FRAMES_PER_SESSION - 60
    session = loop.master.session
    for _ in range(200):
        loop.run_frame()
    assert loop.master.session != session
    assert loop.master.counter < 200
    assert_sound(loop)


@pytest.mark.slow
def test_low_bits_of_numbers_and_frames_wrap() -> None:
    """Sequence numbers and frames have 8 bits on air; 600 of each arrive, with an outage of more than 128 measurements."""
    loop = SuperframeLoop(TIMING, Authenticator(KEY), Random(1).getrandbits)  # noqa: S311 (a test has no secrets)
    for frame in range(700):
        loop.run_frame(missed_by=(2,) if 150 <= frame < 400 else ())
    assert loop.master.counter > 2 * 256
    assert max(loop.members[1].received) > 2 * 256
    assert_sound(loop)
