"""Beacons that somebody jams at a station and plays to it later: what it measures keeps its time, or a bound says so."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import pytest
from harness.exchange import MS, Exchange
from harness.frames import KEY, TIMING

from tsgt.radio import DirectCommand
from tsgt.radio.superframe.wire import Authenticator

if TYPE_CHECKING:
    from collections.abc import Collection

    from harness.exchange import Member

DELAYS_NS = (300_000, 3 * MS, 30 * MS)
LONG_DELAYS_NS = (66 * MS, 80 * MS, 131 * MS, 248 * MS)
"""Longer than the low bits of a time tell; by 131 ms they are nearly the same again."""


def exchange_of(frames: int = 0) -> Exchange:
    """Return an exchange of three stations that has been under way for so many frames."""
    exchange = Exchange(TIMING, Authenticator(KEY), Random(1).getrandbits)  # noqa: S311 (a test has no secrets)
    for _ in range(frames):
        exchange.frame()
    return exchange


def hold_back(exchange: Exchange, late_ns: int, frames: int, which: Collection[int]) -> dict[int, str]:
    """Run frames, hold some beacons back from station 2; return in which frames the master has found that out, and how."""
    told = {}
    for frame in range(frames):
        exchange.frame(late_ns={2: late_ns} if frame in which else {})
        heard = exchange.heard.get(2)
        if heard is not None and heard.rejected_beacons:
            told[frame] = "beacon_time_rejected"
        elif heard is not None and heard.link_delay_anomaly:
            told[frame] = "link_delay_anomaly"
    return told


def timestamp_violations(member: Member) -> dict[int, int]:
    """Return by how much times are further off than they are said to be."""
    beyond = {k: abs(off) - member.received[k].bound_ns for k, off in member.errors_ns().items()}
    return {number: ns for number, ns in beyond.items() if ns > 0}


@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS)
def test_a_single_beacon_shifts_no_time(late_ns: int) -> None:
    """Every tenth one is held back: times stay as good as they were, and the master is told of it."""
    exchange = exchange_of(60)
    told = hold_back(exchange, late_ns, 60, range(0, 60, 10))
    member = exchange.members[2]
    errors_ns = member.errors_ns()
    assert max(abs(errors_ns[k]) for k in errors_ns if k > 20) < 60_000
    assert timestamp_violations(member) == {}
    if late_ns != 131 * MS:
        assert list(told.values()).count("beacon_time_rejected") >= 3
        assert min(told) == 1


@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS[:2])
def test_from_some_time_on_all_are_held_back(late_ns: int) -> None:
    """The station follows what it cannot tell from another rate; the master knows at once and says how far times are off."""
    exchange = exchange_of(60)
    told = hold_back(exchange, late_ns, 100, range(100))
    assert min(told) == 1
    assert list(told.values()).count("link_delay_anomaly") >= 3
    assert timestamp_violations(exchange.members[2]) == {}


@pytest.mark.parametrize("late_ns", DELAYS_NS[1:] + LONG_DELAYS_NS[:-1])
def test_all_are_held_back_from_the_start(late_ns: int) -> None:
    """The round trip is longer than any chip makes it, and the bound contains what it may be."""
    exchange = exchange_of()
    assert "link_delay_anomaly" in hold_back(exchange, late_ns, 100, range(100)).values()
    assert timestamp_violations(exchange.members[2]) == {}


def test_less_than_chips_may_differ_by_is_not_noticed_from_the_start() -> None:
    """0.3 ms of delay pass for a link constant of 0.15 ms more; times are off by the other half."""
    exchange = exchange_of()
    assert hold_back(exchange, 300_000, 100, range(100)) == {}
    errors_ns = exchange.members[2].errors_ns()
    assert 140_000 < max(abs(errors_ns[k]) for k in errors_ns if k > 40) < 200_000


@pytest.mark.parametrize("late_ns", [500_000, 900_000, 1_000_000])
def test_what_a_delay_below_a_millisecond_shifts_times_by(late_ns: int) -> None:
    """From the start on, times are off by half of it and a little, which no bound says; beyond a millisecond it is noticed."""
    exchange = exchange_of()
    told = hold_back(exchange, late_ns, 150, range(150))
    errors_ns = exchange.members[2].errors_ns()
    assert max(abs(errors_ns[k]) for k in errors_ns if k > 40) < 650_000
    assert bool(told) == (late_ns >= MS)


@pytest.mark.parametrize("step_ns", [1_000, 10_000, 25_000])
def test_a_delay_that_grows_is_noticed_and_bounded_to_half_a_millisecond(step_ns: int) -> None:
    """It looks like a clock that runs fast; times are off by no more than that beyond what is stated of them."""
    exchange = exchange_of(60)
    told = []
    for frame in range(300):
        exchange.frame(late_ns={2: min(frame * step_ns, 3 * MS)})
        heard = exchange.heard.get(2)
        if heard is not None and (heard.link_delay_anomaly or heard.rejected_beacons):
            told.append(frame)
    assert min(told) * step_ns < 400_000
    assert max(timestamp_violations(exchange.members[2]).values(), default=0) < 500_000


@pytest.mark.parametrize("backlog_s", [0, 20])
@pytest.mark.parametrize("which", [[0], [0, 1], [1], [2], [0, 1, 2], [3, 4], [0, 1, 2, 3]])
@pytest.mark.parametrize("late_ns", DELAYS_NS + LONG_DELAYS_NS)
def test_the_first_beacons_of_a_station(late_ns: int, which: list[int], backlog_s: int) -> None:
    """It knows no better than them, and says so; also of what it measured before it heard any."""
    exchange = exchange_of()
    member = exchange.members[2]
    member.next_ns -= backlog_s * 1000 * MS
    hold_back(exchange, late_ns, 60, which)
    assert timestamp_violations(member) == {}
    assert set(member.made_ns) - set(member.received) <= set(
        range(len(member.made_ns) - 3, len(member.made_ns))
    )


@pytest.mark.parametrize("frames", [0, 60])
@pytest.mark.parametrize("late_ns", LONG_DELAYS_NS)
@pytest.mark.parametrize("off_ms", [-49, 49])
def test_a_reply_whose_end_the_master_has_not_seen_to_the_moment(
    off_ms: int, late_ns: int, frames: int
) -> None:
    """An interrupt was lost and the reply found by looking, at best within 50 ms: by so much it may have been later."""
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
def test_the_first_beacons_after_an_outage(away_s: int, late_us: int, many: int) -> None:
    """A clock may have run off by so much meanwhile; but what a few beacons alone say is no reason to believe it."""
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
def test_an_interrupt_that_the_master_loses_after_it(late_ms: int) -> None:
    """It cannot say when that beacon left, so that the station cannot find out that those before it were late."""
    exchange = exchange_of()
    for _ in range(40):
        exchange.frame(deaf=[2])
    member = exchange.members[2]
    member.made_ns.clear()
    member.next_ns = exchange.now_ns - 130_000 * MS
    member.measure(exchange.now_ns - 90_000 * MS)
    member.next_ns = exchange.now_ns + 1_000_000 * MS  # it has lost its prism
    hold_back(exchange, 0, 1, ())
    hold_back(exchange, late_ms * MS, 2, range(2))
    exchange.begin(sigma_ns=MS)
    received_ns = exchange.hear(2)
    assert received_ns is not None
    exchange.deliver(2, received_ns)
    exchange.end()
    hold_back(exchange, 0, 60, ())
    assert timestamp_violations(member) == {}


def test_what_five_in_a_row_that_were_held_back_leave_behind() -> None:
    """They are a clock that was touched: what was measured before and is told afterwards is off by as much, unsaid."""
    exchange = exchange_of()
    member = exchange.members[2]
    member.next_ns -= 60_000 * MS
    hold_back(exchange, 40 * MS, 60, range(6))
    assert 30 * MS < max(timestamp_violations(member).values()) < 40 * MS


@pytest.mark.parametrize("late_s", [2, 20])
def test_beacons_that_were_missed_are_no_time(late_s: int) -> None:
    """A station that hears no master is played what it has missed: authentic, new to it, and seconds old."""
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


def test_a_session_of_yesterday_played_back() -> None:
    """To a station that hears no master: never confirmed, nothing deleted, nothing obeyed; the real one is heard at once."""
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
    assert 2 in exchange.heard
    assert member.core.joined
    for _ in range(60):
        exchange.frame()
    assert timestamp_violations(member) == {}
    assert set(member.made_ns) - set(member.received) <= set(
        range(len(member.made_ns) - 3, len(member.made_ns))
    )


def test_a_session_of_yesterday_played_to_a_station_that_was_just_started() -> None:
    """It draws another nonce for each session, so that the confirmation of yesterday's is not one of today's."""
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
def test_a_reply_with_an_old_measurement_is_held_back(earlier_ms: int, late_ms: int) -> None:
    """Times that repeat after 2.1 s are not taken for the next ones, and nothing is acknowledged that was not taken."""
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
def test_what_was_measured_before_is_not_told_by_first_beacons_that_were_held_back_alike(
    late_ms: int, away_s: int, which: list[int]
) -> None:
    """The prism was out of sight when the station joined: what it tells is old, and two beacons that agree are no clock yet."""
    exchange = exchange_of()
    member = exchange.members[2]
    member.next_ns = exchange.now_ns - (away_s + 40) * 1000 * MS
    member.measure(exchange.now_ns - away_s * 1000 * MS)
    member.next_ns = exchange.now_ns + 1_000_000 * MS
    hold_back(exchange, late_ms * MS, 60, which)
    assert timestamp_violations(member) == {}
    assert set(member.received) == set(member.made_ns)


@pytest.mark.parametrize(("late_ms", "which"), [(2, [1, 2]), (3, [3, 4]), (5, [3])])
def test_what_cannot_be_told_to_half_a_second_does_not_wait_for_ever(late_ms: int, which: list[int]) -> None:
    """The master comes three hours late, and the first beacons tell the rate badly: nothing more is known of what is oldest."""
    exchange = exchange_of()
    member = exchange.members[2]
    for minutes in range(180, 0, -1):
        member.next_ns = exchange.now_ns - minutes * 60_000 * MS
        member.measure(member.next_ns)
    member.next_ns = exchange.now_ns
    hold_back(exchange, late_ms * MS, 300, which)
    assert timestamp_violations(member) == {}
    left = (
        set(member.made_ns) - set(member.received) - set(range(len(member.made_ns) - 3, len(member.made_ns)))
    )
    assert 10 < len(left) < 130
    assert left == set(range(len(left)))
    assert exchange.master.station(2).window.outstanding == 0
    assert member.send_queue.oldest > max(left)
