"""Delayed and replayed beacons: timestamps stay within their bounds, or the master reports an anomaly."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import pytest
from harness.superframe_loop import MS, Exchange
from harness.scripted_stations import KEY, TIMING

from tsgt.radio import DirectCommand
from tsgt.radio.superframe.wire import Authenticator

if TYPE_CHECKING:
    from collections.abc import Collection

    from harness.superframe_loop import Member

DELAYS_NS = (300_000, 3 * MS, 30 * MS)
LONG_DELAYS_NS = (66 * MS, 80 * MS, 131 * MS, 248 * MS)
"""Longer than the low bits of a time tell; by 131 ms they are nearly the same again."""


def exchange_of(frames: int = 0) -> Exchange:
    """Return an exchange of three stations after this many frames."""
    exchange = Exchange(TIMING, Authenticator(KEY), Random(1).getrandbits)  # noqa: S311 (a test has no secrets)
    for _ in range(frames):
        exchange.frame()
    return exchange


def delay_beacons(exchange: Exchange, late_ns: int, frames: int, which: Collection[int]) -> dict[int, str]:
    """Run frames, delay some beacons to station 2; return the frames in which the master detects it, and by which event."""
    told = {}
    for frame in range(frames):
        exchange.frame(late_ns={2: late_ns} if frame in which else {})
        received = exchange.received_replies.get(2)
        if received is not None and received.rejected_beacons:
            told[frame] = "beacon_time_rejected"
        elif received is not None and received.link_delay_anomaly:
            told[frame] = "link_delay_anomaly"
    return told


def timestamp_violations(member: Member) -> dict[int, int]:
    """Return by how much timestamp errors exceed their bounds."""
    beyond = {k: abs(off) - member.received[k].bound_ns for k, off in member.errors_ns().items()}
    return {number: ns for number, ns in beyond.items() if ns > 0}


@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS)
def test_single_delayed_beacon_is_rejected(late_ns: int) -> None:
    """One in ten is delayed: timestamps stay accurate, and the master gets an event."""
    exchange = exchange_of(60)
    told = delay_beacons(exchange, late_ns, 60, range(0, 60, 10))
    member = exchange.members[2]
    errors_ns = member.errors_ns()
    assert max(abs(errors_ns[k]) for k in errors_ns if k > 20) < 60_000
    assert timestamp_violations(member) == {}
    if late_ns != 131 * MS:
        assert list(told.values()).count("beacon_time_rejected") >= 3
        assert min(told) == 1


@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS[:2])
def test_constant_delay_from_some_time_on_is_reported(late_ns: int) -> None:
    """The station cannot separate it from skew; the master enlarges the bound at once."""
    exchange = exchange_of(60)
    told = delay_beacons(exchange, late_ns, 100, range(100))
    assert min(told) == 1
    assert list(told.values()).count("link_delay_anomaly") >= 3
    assert timestamp_violations(exchange.members[2]) == {}


@pytest.mark.parametrize("late_ns", DELAYS_NS[1:] + LONG_DELAYS_NS[:-1])
def test_constant_delay_from_the_start_is_bounded(late_ns: int) -> None:
    """The link delay is impossible, and the bound contains the delay."""
    exchange = exchange_of()
    assert "link_delay_anomaly" in delay_beacons(exchange, late_ns, 100, range(100)).values()
    assert timestamp_violations(exchange.members[2]) == {}


def test_delay_within_chip_tolerance_is_undetected() -> None:
    """0.3 ms of delay count as 0.15 ms of link delay; timestamps are off by the other half."""
    exchange = exchange_of()
    assert delay_beacons(exchange, 300_000, 100, range(100)) == {}
    errors_ns = exchange.members[2].errors_ns()
    assert 140_000 < max(abs(errors_ns[k]) for k in errors_ns if k > 40) < 200_000


@pytest.mark.parametrize("late_ns", [500_000, 900_000, 1_000_000])
def test_delay_below_a_millisecond_shifts_timestamps(late_ns: int) -> None:
    """By half the delay, beyond the bound; a larger delay is detected."""
    exchange = exchange_of()
    told = delay_beacons(exchange, late_ns, 150, range(150))
    errors_ns = exchange.members[2].errors_ns()
    assert max(abs(errors_ns[k]) for k in errors_ns if k > 40) < 650_000
    assert bool(told) == (late_ns >= MS)


@pytest.mark.parametrize("step_ns", [1_000, 10_000, 25_000])
def test_growing_delay_is_detected(step_ns: int) -> None:
    """It resembles skew; timestamps exceed their bounds by at most half a millisecond."""
    exchange = exchange_of(60)
    told = []
    for frame in range(300):
        exchange.frame(late_ns={2: min(frame * step_ns, 3 * MS)})
        received = exchange.received_replies.get(2)
        if received is not None and (received.link_delay_anomaly or received.rejected_beacons):
            told.append(frame)
    assert min(told) * step_ns < 400_000
    assert max(timestamp_violations(exchange.members[2]).values(), default=0) < 500_000


@pytest.mark.parametrize("backlog_s", [0, 20])
@pytest.mark.parametrize("which", [[0], [0, 1], [1], [2], [0, 1, 2], [3, 4], [0, 1, 2, 3]])
@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS)
def test_delayed_first_beacons_stay_within_bounds(late_ns: int, which: list[int], backlog_s: int) -> None:
    """Including measurements made before the first beacon."""
    exchange = exchange_of()
    member = exchange.members[2]
    member.next_ns -= backlog_s * 1000 * MS
    delay_beacons(exchange, late_ns, 60, which)
    assert timestamp_violations(member) == {}
    assert set(member.made_ns) - set(member.received) <= set(
        range(len(member.made_ns) - 3, len(member.made_ns))
    )


@pytest.mark.parametrize("frames", [0, 60])
@pytest.mark.parametrize("late_ns", LONG_DELAYS_NS)
@pytest.mark.parametrize("off_ms", [-49, 49])
def test_inexact_reply_timestamp_enlarges_bound(off_ms: int, late_ns: int, frames: int) -> None:
    """The interrupt was lost and the reply found by polling, within 50 ms."""
    exchange = exchange_of(frames)
    for _ in range(3):
        exchange.begin()
        received_ns = exchange.hear(2, late_ns=late_ns)
        assert received_ns is not None
        exchange.deliver(2, received_ns + off_ms * MS, sigma_ns=29 * MS)
        exchange.end()
    assert timestamp_violations(exchange.members[2]) == {}


@pytest.mark.parametrize("many", [1, 4])
@pytest.mark.parametrize(("away_s", "late_us"), [(60, 1_500), (120, 3_000), (300, 8_000)])
def test_delayed_beacons_after_outage_are_rejected(away_s: int, late_us: int, many: int) -> None:
    """The clock may have drifted by as much, but few beacons are no evidence."""
    exchange = exchange_of(60)
    member, until_ns = exchange.members[2], exchange.now_ns + away_s * 1000 * MS
    while exchange.now_ns < until_ns:
        exchange.frame(deaf=[2])
    while many:
        before_ns = member.core.heard_ns
        exchange.frame(late_ns={2: 1000 * late_us})
        many -= member.core.heard_ns != before_ns
    for _ in range(120):
        exchange.frame()
    assert timestamp_violations(member) == {}


@pytest.mark.parametrize("late_ms", [65, 80])
def test_delay_before_inexact_beacon_stays_within_bounds(late_ms: int) -> None:
    """The station cannot compare the beacon whose time is unknown."""
    exchange = exchange_of()
    for _ in range(40):
        exchange.frame(deaf=[2])
    member = exchange.members[2]
    member.made_ns.clear()
    member.next_ns = exchange.now_ns - 130_000 * MS
    member.measure(exchange.now_ns - 90_000 * MS)
    member.next_ns = exchange.now_ns + 1_000_000 * MS  # it has lost its prism
    delay_beacons(exchange, 0, 1, ())
    delay_beacons(exchange, late_ms * MS, 2, range(2))
    exchange.begin(sigma_ns=MS)
    received_ns = exchange.hear(2)
    assert received_ns is not None
    exchange.deliver(2, received_ns)
    exchange.end()
    delay_beacons(exchange, 0, 60, ())
    assert timestamp_violations(member) == {}


def test_five_delayed_beacons_start_a_clock_segment() -> None:
    """Backlog timestamps are off by the delay, beyond their bounds: a known limit."""
    exchange = exchange_of()
    member = exchange.members[2]
    member.next_ns -= 60_000 * MS
    delay_beacons(exchange, 40 * MS, 60, range(6))
    assert 30 * MS < max(timestamp_violations(member).values()) < 40 * MS


@pytest.mark.parametrize("late_s", [2, 20])
def test_replayed_missed_beacons_are_rejected(late_s: int) -> None:
    """They are authentic and new to the station, but seconds old."""
    exchange = exchange_of(60)
    member = exchange.members[2]
    late_ns = late_s * 1000 * MS
    recorded, until_ns = list[tuple[int, bytes]](), exchange.now_ns + late_ns + 15_000 * MS
    while exchange.now_ns < until_ns:
        recorded.append((exchange.begin(), exchange.done_ns + late_ns)[::-1])
        while recorded[0][0] <= exchange.done_ns:
            played_ns, beacon = recorded.pop(0)
            exchange.hear(2, late_ns=played_ns - exchange.done_ns, beacon=beacon)
        exchange.end()
    for _ in range(20):
        exchange.frame()
    assert member.core.rejected_beacons > 20
    assert timestamp_violations(member) == {}
    assert max(map(abs, member.errors_ns().values())) < 100_000
    assert set(member.made_ns) - set(member.received) <= set(
        range(len(member.made_ns) - 3, len(member.made_ns))
    )


def test_replayed_session_is_never_confirmed() -> None:
    """Nothing is deleted, no command executed, and the real master is joined at once."""
    yesterday = Exchange(TIMING, Authenticator(KEY), Random(2).getrandbits, start_ns=1000 * MS)  # noqa: S311 (as above)
    recorded = []
    for frame in range(200):
        if frame % 20 == 0:
            yesterday.master.station(2).submit(DirectCommand())
        yesterday.frame()
        recorded.append(yesterday.beacon)
    exchange = exchange_of(60)
    member = exchange.members[2]
    joined = []
    for beacon in recorded:
        exchange.frame(deaf=[2])
        before = len(member.send_queue)
        exchange.hear(2, beacon=beacon, late_ns=200 * MS)
        joined.append(member.core.joined)
        assert len(member.send_queue) >= before
        assert member.core.next_command() is None
    assert not any(joined[40:])  # from the first one on that tells of its session
    exchange.frame()
    assert 2 in exchange.received_replies
    assert member.core.joined
    for _ in range(60):
        exchange.frame()
    assert timestamp_violations(member) == {}
    assert set(member.made_ns) - set(member.received) <= set(
        range(len(member.made_ns) - 3, len(member.made_ns))
    )


def test_replayed_session_does_not_confirm_new_station() -> None:
    """The station draws another nonce for each session."""
    yesterday, today = exchange_of(), Exchange(TIMING, Authenticator(KEY), Random(3).getrandbits)  # noqa: S311 (as above)
    recorded = []
    for _ in range(20):
        yesterday.frame()
        recorded.append(yesterday.beacon)
    assert yesterday.members[2].core.joined
    for beacon in recorded:
        today.frame(deaf=[1, 2, 3])
        today.hear(2, beacon=beacon, late_ns=200 * MS)
        assert not today.members[2].core.joined


@pytest.mark.parametrize("earlier_ms", [40, 140])
@pytest.mark.parametrize("late_ms", [50, 100, 220])
def test_delayed_reply_with_old_measurement_is_ignored(earlier_ms: int, late_ms: int) -> None:
    """Its narrow times may have wrapped; the measurement is not acknowledged and arrives later."""
    exchange = exchange_of(60)
    member = exchange.members[2]
    made = len(member.made_ns)
    member.next_ns -= earlier_ms * MS
    for frame in range(8):
        exchange.begin()
        for number in exchange.members:
            received_ns = exchange.hear(number)
            if number == 2 and frame == 3 and received_ns is not None:
                exchange.deliver(2, received_ns + late_ms * MS)
        if len(member.made_ns) > made:
            member.next_ns = exchange.now_ns + 60_000 * MS  # the prism is out of sight
        exchange.end()
    for _ in range(20):
        exchange.frame()
    assert timestamp_violations(member) == {}
    assert max(map(abs, member.errors_ns().values())) < 100_000
    assert set(member.received) == set(member.made_ns)


@pytest.mark.parametrize("which", [[0, 1], [1, 2], [0, 1, 2], [1, 2, 3], [1, 2, 3, 4]])
@pytest.mark.parametrize("away_s", [0, 20, 60])
@pytest.mark.parametrize("late_ms", [10, 20, 29])
def test_equally_delayed_first_beacons_give_no_backlog_timestamps(
    late_ms: int, away_s: int, which: list[int]
) -> None:
    """Two beacons that agree are not enough for measurements made before them."""
    exchange = exchange_of()
    member = exchange.members[2]
    member.next_ns = exchange.now_ns - (away_s + 40) * 1000 * MS
    member.measure(exchange.now_ns - away_s * 1000 * MS)
    member.next_ns = exchange.now_ns + 1_000_000 * MS
    delay_beacons(exchange, late_ms * MS, 60, which)
    assert timestamp_violations(member) == {}
    assert set(member.received) == set(member.made_ns)


@pytest.mark.parametrize(("late_ms", "which"), [(2, [1, 2]), (3, [3, 4]), (5, [3])])
def test_untimeable_oldest_measurements_are_discarded(late_ms: int, which: list[int]) -> None:
    """The master comes three hours late, and its first beacons leave the skew uncertain."""
    exchange = exchange_of()
    member = exchange.members[2]
    for minutes in range(180, 0, -1):
        member.next_ns = exchange.now_ns - minutes * 60_000 * MS
        member.measure(member.next_ns)
    member.next_ns = exchange.now_ns
    delay_beacons(exchange, late_ms * MS, 300, which)
    assert timestamp_violations(member) == {}
    left = (
        set(member.made_ns) - set(member.received) - set(range(len(member.made_ns) - 3, len(member.made_ns)))
    )
    assert 10 < len(left) < 130
    assert left == set(range(len(left)))
    assert exchange.master.station(2).window.outstanding == 0
    assert member.send_queue.oldest > max(left)
