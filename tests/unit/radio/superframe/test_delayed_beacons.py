"""Delayed and replayed beacons: timestamps stay within their bounds, or the master reports an anomaly."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import pytest
from harness.radio.scripted_stations import KEY, TIMING
from harness.radio.superframe_loop import MS, SuperframeLoop

from tsgt.radio import DirectCommand
from tsgt.radio.superframe.wire import Authenticator

if TYPE_CHECKING:
    from collections.abc import Collection

    from _pytest.mark.structures import ParameterSet
    from harness.radio.superframe_loop import LoopStation

DELAYS_NS = (300_000, 3 * MS, 30 * MS)
LONG_DELAYS_NS = (66 * MS, 80 * MS, 131 * MS, 248 * MS)
"""Beyond the range of the low bits of a time, which nearly wrap after 131 ms."""


def slow(*beacons: list[int]) -> list[ParameterSet]:
    """Return combinations that run in `make test-all` only."""
    return [pytest.param(each, marks=pytest.mark.slow) for each in beacons]


def running_loop(frames: int = 0) -> SuperframeLoop:
    """Return an loop of three stations after this many frames."""
    loop = SuperframeLoop(TIMING, Authenticator(KEY), Random(1).getrandbits)  # noqa: S311 (a test has no secrets)
    for _ in range(frames):
        loop.run_frame()
    return loop


def delay_beacons(loop: SuperframeLoop, late_ns: int, frames: int, which: Collection[int]) -> dict[int, str]:
    """Run frames, delay beacons to station 2; return the frames in which the master detects it, and by which event."""
    events = {}
    for frame in range(frames):
        loop.run_frame(delays_ns={2: late_ns} if frame in which else {})
        received = loop.received_replies.get(2)
        if received is not None and received.rejected_beacons:
            events[frame] = "beacon_time_rejected"
        elif received is not None and received.link_delay_anomaly:
            events[frame] = "link_delay_anomaly"
    return events


def timestamp_violations(member: LoopStation) -> dict[int, int]:
    """Return by how much timestamp errors exceed their bounds."""
    beyond = {k: abs(off) - member.received[k].bound_ns for k, off in member.errors_ns().items()}
    return {number: ns for number, ns in beyond.items() if ns > 0}


@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS)
def test_single_delayed_beacon_is_rejected(late_ns: int) -> None:
    """One in ten is delayed: timestamps stay accurate, and the master gets an event."""
    loop = running_loop(60)
    events = delay_beacons(loop, late_ns, 60, range(0, 60, 10))
    member = loop.members[2]
    errors_ns = member.errors_ns()
    assert max(abs(errors_ns[k]) for k in errors_ns if k > 20) < 60_000
    assert timestamp_violations(member) == {}
    if late_ns != 131 * MS:
        assert list(events.values()).count("beacon_time_rejected") >= 3
        assert min(events) == 1


@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS[:2])
def test_constant_delay_from_some_time_on_is_reported(late_ns: int) -> None:
    """The station cannot separate it from skew; the master enlarges the bound at once."""
    loop = running_loop(60)
    events = delay_beacons(loop, late_ns, 100, range(100))
    assert min(events) == 1
    assert list(events.values()).count("link_delay_anomaly") >= 3
    assert timestamp_violations(loop.members[2]) == {}


@pytest.mark.parametrize("late_ns", DELAYS_NS[1:] + LONG_DELAYS_NS[:-1])
def test_constant_delay_from_the_start_is_bounded(late_ns: int) -> None:
    """The link delay is impossible, and the bound contains the delay."""
    loop = running_loop()
    assert "link_delay_anomaly" in delay_beacons(loop, late_ns, 100, range(100)).values()
    assert timestamp_violations(loop.members[2]) == {}


def test_delay_within_chip_tolerance_is_undetected() -> None:
    """0.3 ms of delay count as 0.15 ms of link delay; timestamps are off by the other half."""
    loop = running_loop()
    assert delay_beacons(loop, 300_000, 100, range(100)) == {}
    errors_ns = loop.members[2].errors_ns()
    assert 140_000 < max(abs(errors_ns[k]) for k in errors_ns if k > 40) < 200_000


@pytest.mark.parametrize("late_ns", [500_000, 900_000, 1_000_000])
def test_delay_below_a_millisecond_shifts_timestamps(late_ns: int) -> None:
    """By half the delay, beyond the bound; a larger delay is detected."""
    loop = running_loop()
    events = delay_beacons(loop, late_ns, 150, range(150))
    errors_ns = loop.members[2].errors_ns()
    assert max(abs(errors_ns[k]) for k in errors_ns if k > 40) < 650_000
    assert bool(events) == (late_ns >= MS)


@pytest.mark.parametrize("step_ns", [1_000, 10_000, 25_000])
@pytest.mark.slow
def test_growing_delay_is_detected(step_ns: int) -> None:
    """It resembles skew; timestamps exceed their bounds by at most half a millisecond."""
    loop = running_loop(60)
    events = []
    for frame in range(300):
        loop.run_frame(delays_ns={2: min(frame * step_ns, 3 * MS)})
        received = loop.received_replies.get(2)
        if received is not None and (received.link_delay_anomaly or received.rejected_beacons):
            events.append(frame)
    assert min(events) * step_ns < 400_000
    assert max(timestamp_violations(loop.members[2]).values(), default=0) < 500_000


@pytest.mark.parametrize("backlog_s", [0, 20])
@pytest.mark.parametrize("which", [[0], [0, 1], *slow([1], [2], [0, 1, 2], [3, 4], [0, 1, 2, 3])])
@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS)
def test_delayed_first_beacons_stay_within_bounds(late_ns: int, which: list[int], backlog_s: int) -> None:
    """Including measurements made before the first beacon."""
    loop = running_loop()
    member = loop.members[2]
    member.next_ns -= backlog_s * 1000 * MS
    delay_beacons(loop, late_ns, 60, which)
    assert timestamp_violations(member) == {}
    assert set(member.made_ns) - set(member.received) <= set(
        range(len(member.made_ns) - 3, len(member.made_ns))
    )


@pytest.mark.parametrize("frames", [0, 60])
@pytest.mark.parametrize("late_ns", LONG_DELAYS_NS)
@pytest.mark.parametrize("off_ms", [-49, 49])
def test_inexact_reply_timestamp_enlarges_bound(off_ms: int, late_ns: int, frames: int) -> None:
    """The interrupt was lost and the reply found by polling, within 50 ms."""
    loop = running_loop(frames)
    for _ in range(3):
        loop.send_beacon()
        received_ns = loop.receive_beacon(2, delay_ns=late_ns)
        assert received_ns is not None
        loop.deliver_reply(2, received_ns + off_ms * MS, sigma_ns=29 * MS)
        loop.end_frame()
    assert timestamp_violations(loop.members[2]) == {}


@pytest.mark.slow
@pytest.mark.parametrize("many", [1, 4])
@pytest.mark.parametrize(("away_s", "late_us"), [(60, 1_500), (120, 3_000), (300, 8_000)])
def test_delayed_beacons_after_outage_are_rejected(away_s: int, late_us: int, many: int) -> None:
    """The clock may have drifted by as much, but few beacons are no evidence."""
    loop = running_loop(60)
    member, until_ns = loop.members[2], loop.now_ns + away_s * 1000 * MS
    while loop.now_ns < until_ns:
        loop.run_frame(missed_by=[2])
    while many:
        before_ns = member.core.heard_ns
        loop.run_frame(delays_ns={2: 1000 * late_us})
        many -= member.core.heard_ns != before_ns
    for _ in range(120):
        loop.run_frame()
    assert timestamp_violations(member) == {}


@pytest.mark.parametrize("late_ms", [65, 80])
def test_delay_before_inexact_beacon_stays_within_bounds(late_ms: int) -> None:
    """The station cannot compare the beacon whose time is unknown."""
    loop = running_loop()
    for _ in range(40):
        loop.run_frame(missed_by=[2])
    member = loop.members[2]
    member.made_ns.clear()
    member.next_ns = loop.now_ns - 130_000 * MS
    member.measure(loop.now_ns - 90_000 * MS)
    member.next_ns = loop.now_ns + 1_000_000 * MS  # it has lost its prism
    delay_beacons(loop, 0, 1, ())
    delay_beacons(loop, late_ms * MS, 2, range(2))
    loop.send_beacon(sigma_ns=MS)
    received_ns = loop.receive_beacon(2)
    assert received_ns is not None
    loop.deliver_reply(2, received_ns)
    loop.end_frame()
    delay_beacons(loop, 0, 60, ())
    assert timestamp_violations(member) == {}


def test_five_delayed_beacons_start_a_clock_segment() -> None:
    """Backlog timestamps are off by the delay, beyond their bounds: a known limit."""
    loop = running_loop()
    member = loop.members[2]
    member.next_ns -= 60_000 * MS
    delay_beacons(loop, 40 * MS, 60, range(6))
    assert 30 * MS < max(timestamp_violations(member).values()) < 40 * MS


@pytest.mark.parametrize("late_s", [2, 20])
def test_replayed_missed_beacons_are_rejected(late_s: int) -> None:
    """They are authentic and new to the station, but seconds old."""
    loop = running_loop(60)
    member = loop.members[2]
    late_ns = late_s * 1000 * MS
    recorded, until_ns = list[tuple[int, bytes]](), loop.now_ns + late_ns + 15_000 * MS
    while loop.now_ns < until_ns:
        recorded.append((loop.send_beacon(), loop.done_ns + late_ns)[::-1])
        while recorded[0][0] <= loop.done_ns:
            played_ns, beacon = recorded.pop(0)
            loop.receive_beacon(2, delay_ns=played_ns - loop.done_ns, beacon=beacon)
        loop.end_frame()
    for _ in range(20):
        loop.run_frame()
    assert member.core.rejected_beacons > 20
    assert timestamp_violations(member) == {}
    assert max(map(abs, member.errors_ns().values())) < 100_000
    assert set(member.made_ns) - set(member.received) <= set(
        range(len(member.made_ns) - 3, len(member.made_ns))
    )


@pytest.mark.slow
def test_replayed_session_is_never_confirmed() -> None:
    """Nothing is deleted, no command executed, and the real master is joined at once."""
    yesterday = SuperframeLoop(TIMING, Authenticator(KEY), Random(2).getrandbits, start_ns=1000 * MS)  # noqa: S311 (as above)
    recorded = []
    for frame in range(200):
        if frame % 20 == 0:
            yesterday.master.station(2).submit(DirectCommand())
        yesterday.run_frame()
        recorded.append(yesterday.beacon)
    loop = running_loop(60)
    member = loop.members[2]
    joined = []
    for beacon in recorded:
        loop.run_frame(missed_by=[2])
        before = len(member.send_queue)
        loop.receive_beacon(2, beacon=beacon, delay_ns=200 * MS)
        joined.append(member.core.joined)
        assert len(member.send_queue) >= before
        assert member.core.next_command() is None
    assert not any(joined[40:])  # from the first beacon with a session item on
    loop.run_frame()
    assert 2 in loop.received_replies
    assert member.core.joined
    for _ in range(60):
        loop.run_frame()
    assert timestamp_violations(member) == {}
    assert set(member.made_ns) - set(member.received) <= set(
        range(len(member.made_ns) - 3, len(member.made_ns))
    )


def test_replayed_session_does_not_confirm_new_station() -> None:
    """The station draws another nonce for each session."""
    yesterday, today = running_loop(), SuperframeLoop(TIMING, Authenticator(KEY), Random(3).getrandbits)  # noqa: S311 (as above)
    recorded = []
    for _ in range(20):
        yesterday.run_frame()
        recorded.append(yesterday.beacon)
    assert yesterday.members[2].core.joined
    for beacon in recorded:
        today.run_frame(missed_by=[1, 2, 3])
        today.receive_beacon(2, beacon=beacon, delay_ns=200 * MS)
        assert not today.members[2].core.joined


@pytest.mark.parametrize("earlier_ms", [40, 140])
@pytest.mark.parametrize("late_ms", [50, 100, 220])
def test_delayed_reply_with_old_measurement_is_ignored(earlier_ms: int, late_ms: int) -> None:
    """Its narrow times may have wrapped; the measurement is not acknowledged and arrives later."""
    loop = running_loop(60)
    member = loop.members[2]
    made = len(member.made_ns)
    member.next_ns -= earlier_ms * MS
    for frame in range(8):
        loop.send_beacon()
        for number in loop.members:
            received_ns = loop.receive_beacon(number)
            if number == 2 and frame == 3 and received_ns is not None:
                loop.deliver_reply(2, received_ns + late_ms * MS)
        if len(member.made_ns) > made:
            member.next_ns = loop.now_ns + 60_000 * MS  # the prism is out of sight
        loop.end_frame()
    for _ in range(20):
        loop.run_frame()
    assert timestamp_violations(member) == {}
    assert max(map(abs, member.errors_ns().values())) < 100_000
    assert set(member.received) == set(member.made_ns)


@pytest.mark.parametrize("which", [[0, 1], *slow([1, 2], [0, 1, 2], [1, 2, 3]), [1, 2, 3, 4]])
@pytest.mark.parametrize("away_s", [0, 20, 60])
@pytest.mark.parametrize("late_ms", [10, 20, 29])
def test_equally_delayed_first_beacons_give_no_backlog_timestamps(
    late_ms: int, away_s: int, which: list[int]
) -> None:
    """Two beacons that agree are not enough for measurements made before them."""
    loop = running_loop()
    member = loop.members[2]
    member.next_ns = loop.now_ns - (away_s + 40) * 1000 * MS
    member.measure(loop.now_ns - away_s * 1000 * MS)
    member.next_ns = loop.now_ns + 1_000_000 * MS
    delay_beacons(loop, late_ms * MS, 60, which)
    assert timestamp_violations(member) == {}
    assert set(member.received) == set(member.made_ns)


@pytest.mark.parametrize(("late_ms", "which"), [(2, [1, 2]), (3, [3, 4]), (5, [3])])
@pytest.mark.slow
def test_untimeable_oldest_measurements_are_discarded(late_ms: int, which: list[int]) -> None:
    """The master comes three hours late, and its first beacons leave the skew uncertain."""
    loop = running_loop()
    member = loop.members[2]
    for minutes in range(180, 0, -1):
        member.next_ns = loop.now_ns - minutes * 60_000 * MS
        member.measure(member.next_ns)
    member.next_ns = loop.now_ns
    delay_beacons(loop, late_ms * MS, 300, which)
    assert timestamp_violations(member) == {}
    left = (
        set(member.made_ns) - set(member.received) - set(range(len(member.made_ns) - 3, len(member.made_ns)))
    )
    assert 10 < len(left) < 130
    assert left == set(range(len(left)))
    assert loop.master.station(2).window.outstanding == 0
    assert member.send_queue.oldest > max(left)
