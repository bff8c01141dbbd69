from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from harness.hardware.radios import MS, PAPER

from tsgt.radio.classic import ClassicStation, LinkTiming, Synchronisation
from tsgt.radio.classic.messages import TimeReply

TIMING = LinkTiming(PAPER, 250 * MS)
PING_NS = TIMING.airtime_ns(2)
FORWARD_NS = PING_NS + TIMING.rx_done_ns
TURNAROUND_NS = 3 * MS
OFFSET_NS = 1_600_000_000_000_000_000

Modify = Callable[["Exchange"], None]


@dataclass
class Exchange:
    """A request and its replies, which a test may change.

    Attributes
    ----------
    received
        Whether the station receives the request.
    replies
        Payloads, with the time from the start of the request to RxDone.
    exact
        Whether the timestamps are edges.
    """

    number: int
    payload: bytes
    sent_ns: int
    received: bool = True
    replies: list[tuple[bytes, int]] = field(default_factory=list)
    exact: bool = True


class Link:
    """A station on a clock that is ahead, and the link to it."""

    def __init__(self, modify: Modify = lambda _: None, after: Modify = lambda _: None) -> None:
        self.station = ClassicStation(1)
        self.offset_ns = OFFSET_NS
        self.late_ns = 0
        self.sent: list[bytes] = []
        self._modify = modify
        self._after = after
        self._now_ns = 0

    def run(self, turn: Synchronisation) -> None:
        """Run a transaction to its end."""
        while (request := turn.request()) is not None:
            self.sent.append(request.payload)
            exchange = Exchange(len(self.sent) - 1, request.payload, self._now_ns)
            self._modify(exchange)
            if exchange.received:
                stamp_ns = exchange.sent_ns + FORWARD_NS + self.late_ns + self.offset_ns
                reply = self.station.received(request.payload, stamp_ns)
                if isinstance(reply, bytes):
                    back_ns = self.late_ns + TURNAROUND_NS + TIMING.airtime_ns(len(reply)) + TIMING.rx_done_ns
                    exchange.replies.append((reply, FORWARD_NS + back_ns))
            self._after(exchange)
            self._now_ns += PING_NS
            if not request.reply_timeout_ns:
                continue
            for payload, after_ns in sorted(exchange.replies, key=lambda reply: reply[1]):
                received_ns = exchange.sent_ns + after_ns
                if turn.accept_reply(
                    payload, sent_ns=exchange.sent_ns, received_ns=received_ns, exact=exchange.exact
                ):
                    self._now_ns = received_ns + MS
                    break
            else:
                self._now_ns += request.reply_timeout_ns
                turn.timed_out()
            assert len(self.sent) < 1000, "the transaction does not end"


def _offsets_ns(turn: Synchronisation) -> list[int]:
    return [sample.station_ns - sample.sent_ns - sample.forward_ns for sample in turn.samples]


def test_cycle_has_four_messages() -> None:
    """Enter, ping and timestamp as often as there are cycles, leave."""
    link, turn = Link(), Synchronisation(1, 2, TIMING)
    link.run(turn)
    assert link.sent == [b"p1", b"e1", b"s1", b"e1", b"s1", b"c1", b"c1"]
    assert (turn.has_reply, turn.missed_replies) == (True, 0)


def test_sample_has_offset_and_excess() -> None:
    """The forward way gives the exact offset; the excess of the round trip is the turnaround."""
    link, turn = Link(), Synchronisation(1, 3, TIMING)
    link.run(turn)
    assert _offsets_ns(turn) == [OFFSET_NS] * 3
    assert [sample.excess_ns for sample in turn.samples] == [TURNAROUND_NS] * 3


def test_known_timestamp_delay_is_subtracted() -> None:
    """A station that polls its radio timestamps late by a known delay."""
    link, turn = Link(), Synchronisation(1, 1, TIMING, timestamp_delay_ns=2 * MS)
    link.late_ns = 2 * MS
    link.run(turn)
    assert _offsets_ns(turn) == [OFFSET_NS]


def test_silent_station_ends_the_synchronisation() -> None:
    """After three requests without a reply the node is commanded to leave."""

    def lose_requests(exchange: Exchange) -> None:
        exchange.received = False

    link, turn = Link(lose_requests), Synchronisation(1, 50, TIMING)
    link.run(turn)
    assert link.sent == [b"p1", b"e1", b"p1", b"s1", b"p1", b"s1", b"c1", b"c1"]
    assert (turn.has_reply, turn.missed_replies, turn.samples) == (False, 3, [])


def test_lost_ping_is_repeated_after_a_flush() -> None:
    """The station first replies to another request; one cycle in five may be missing."""

    def lose_packets(exchange: Exchange) -> None:
        exchange.received = exchange.number != 3

    link, turn = Link(lose_packets), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert link.sent[3:8] == [b"e1", b"p1", b"s1", b"e1", b"s1"]
    assert _offsets_ns(turn) == [OFFSET_NS] * 4


def test_lost_timestamp_is_requested_again() -> None:
    """The station still has it, so the cycle is not lost."""

    def lose_packets(exchange: Exchange) -> None:
        if exchange.number == 2:
            exchange.replies.clear()

    link, turn = Link(after=lose_packets), Synchronisation(1, 1, TIMING)
    link.run(turn)
    assert link.sent == [b"p1", b"e1", b"s1", b"s1", b"c1", b"c1"]
    assert turn.missed_replies == 1
    assert _offsets_ns(turn) == [OFFSET_NS]


def test_synchronisation_with_heavy_loss_ends() -> None:
    """Cycles without a sample are repeated, but at most as many again."""

    def lose_packets(exchange: Exchange) -> None:
        exchange.received = exchange.payload != b"e1" or exchange.number % 2 == 1

    link, turn = Link(lose_packets), Synchronisation(1, 10, TIMING)
    link.run(turn)
    assert link.sent.count(b"e1") <= 20
    assert set(_offsets_ns(turn)) == {OFFSET_NS}


def test_late_ping_reply_makes_no_sample() -> None:
    """The timestamp of a ping whose reply was late is not combined with a later ping."""
    late: list[tuple[bytes, int]] = []

    def stalled(exchange: Exchange) -> None:
        if exchange.number == 3:
            late.extend(exchange.replies)
            exchange.replies.clear()
        elif exchange.number == 5:
            exchange.replies += [(payload, after_ns + 10 * MS) for payload, after_ns in late]

    link, turn = Link(after=stalled), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert link.sent[3:7] == [b"e1", b"p1", b"s1", b"e1"]
    assert _offsets_ns(turn) == [OFFSET_NS] * 4


def test_early_reply_is_rejected() -> None:
    """A reply earlier than possible is an old one."""

    def echo(exchange: Exchange) -> None:
        if exchange.payload == b"e1":
            exchange.received = exchange.number != 3
            exchange.replies.append((b"e1", PING_NS + 20 * MS))

    link, turn = Link(echo), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert _offsets_ns(turn) == [OFFSET_NS] * 4
    assert all(sample.excess_ns == TURNAROUND_NS for sample in turn.samples)


def test_repeated_timestamp_makes_no_sample() -> None:
    """A replayed reply of an earlier cycle makes no sample."""
    old: list[tuple[bytes, int]] = []

    def replayed(exchange: Exchange) -> None:
        if exchange.number == 1:
            old.extend(exchange.replies)
        elif exchange.number == 3:
            exchange.replies = [(b"e1", after_ns) for _, after_ns in old]

    def lose_requests(exchange: Exchange) -> None:
        exchange.received = exchange.number != 3

    link, turn = Link(lose_requests, replayed), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert _offsets_ns(turn) == [OFFSET_NS] * 4
    assert link.sent[5:7] == [b"p1", b"s1"]


def test_station_without_a_timestamp_makes_no_sample() -> None:
    """It restarted between the ping and the request for its timestamp."""

    def restart(exchange: Exchange) -> None:
        if exchange.number == 2:
            link.station = ClassicStation(1)

    link = Link(restart)
    turn = Synchronisation(1, 1, TIMING)
    link.run(turn)
    assert _offsets_ns(turn) == [OFFSET_NS]
    assert link.sent.count(b"e1") == 2


@pytest.mark.parametrize("payload", [b"e2", b"s" + bytes(8), b"t1", b"dOk", bytes(34), b"\xff\xff"])
def test_other_packets_do_not_disturb_a_ping(payload: bytes) -> None:
    """Other stations' replies and unknown packets are ignored while a ping's reply is pending."""

    def busy(exchange: Exchange) -> None:
        if exchange.payload == b"e1":
            exchange.replies.append((payload, FORWARD_NS + PING_NS))

    link, turn = Link(busy), Synchronisation(1, 3, TIMING)
    link.run(turn)
    assert _offsets_ns(turn) == [OFFSET_NS] * 3


def test_timestamp_of_another_station_is_dropped() -> None:
    """A time reply does not name its station; the other cycles exclude a wrong one."""
    other_reply = TimeReply(OFFSET_NS + 12_345_000 * MS).to_bytes()

    def disturbed(exchange: Exchange) -> None:
        if exchange.number == 6:
            exchange.replies.append((other_reply, FORWARD_NS + TIMING.airtime_ns(9)))

    link, turn = Link(disturbed), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert set(_offsets_ns(turn)) == {OFFSET_NS}
    assert len(turn.samples) >= 3


def test_the_last_cycle_cannot_outvote_the_others() -> None:
    """A wrong timestamp in the last cycle causes more cycles, which exclude it."""
    other_reply = TimeReply(OFFSET_NS + 12_345_000 * MS).to_bytes()

    def disturbed(exchange: Exchange) -> None:
        if exchange.number == 10:
            exchange.replies.append((other_reply, FORWARD_NS + TIMING.airtime_ns(9)))

    link, turn = Link(disturbed), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert _offsets_ns(turn) == [OFFSET_NS] * 3


def test_step_drops_earlier_samples() -> None:
    """Samples from before a step of the clock are dropped."""

    def step(exchange: Exchange) -> None:
        if exchange.number == 7:
            link.offset_ns += 3_600_000 * MS

    link = Link(step)
    turn = Synchronisation(1, 10, TIMING)
    link.run(turn)
    assert set(_offsets_ns(turn)) == {OFFSET_NS + 3_600_000 * MS}
    assert len(turn.samples) >= 5


def test_continual_steps_give_no_samples() -> None:
    """Samples that are inconsistent to the end are dropped."""

    def step(exchange: Exchange) -> None:
        if exchange.payload == b"e1":
            link.offset_ns += 1000 * MS

    link = Link(step)
    turn = Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert turn.samples == []
    assert turn.has_reply


def test_late_timestamps_are_consistent_with_early_ones() -> None:
    """A busy station timestamps and replies late: its intervals are wider, and all cycles count."""

    def busy(exchange: Exchange) -> None:
        link.late_ns = 40 * MS if exchange.number % 4 == 1 else 0

    link = Link(busy)
    turn = Synchronisation(1, 6, TIMING)
    link.run(turn)
    assert sorted(_offsets_ns(turn)) == [OFFSET_NS] * 3 + [OFFSET_NS + 40 * MS] * 3


def test_skew_is_no_inconsistency() -> None:
    """A crystal 100 ppm off gives a sample with each received ping, also with timeouts in between."""
    lost: list[bytes] = []

    def drift(exchange: Exchange) -> None:
        link.offset_ns = OFFSET_NS + exchange.sent_ns // 10_000
        exchange.received = exchange.number % 9 != 5
        if not exchange.received:
            lost.append(exchange.payload)

    link = Link(drift)
    turn = Synchronisation(1, 50, TIMING)
    link.run(turn)
    assert len(turn.samples) == 50 - lost.count(b"e1") == 38


def test_inexact_timestamps_make_no_sample() -> None:
    """A cycle whose edges were lost is skipped without requesting the timestamp."""

    def lost_edge(exchange: Exchange) -> None:
        exchange.exact = exchange.number != 3

    link, turn = Link(lost_edge), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert link.sent[3:6] == [b"e1", b"e1", b"s1"]
    assert len(turn.samples) == 4


@pytest.mark.parametrize(
    ("lost_requests_of", "lost", "samples", "silence_ms"),
    [({7, 9}, {12}, 3, 840), ({7, 9}, set[int](), 4, 0), (set(range(7, 30)), set[int](), 3, 0)],
    ids=["before its last answers", "before its last sample", "at the end"],
)
def test_silence_without_a_later_sample_is_reported(
    lost_requests_of: set[int], lost: set[int], samples: int, silence_ms: int
) -> None:
    """The station may have restarted in it and been pinged afterwards; at the end no ping follows."""

    def lost_requests(exchange: Exchange) -> None:
        exchange.received = exchange.number not in lost_requests_of

    def lost_replies(exchange: Exchange) -> None:
        if exchange.number in lost:
            exchange.replies.clear()

    link, turn = Link(lost_requests, lost_replies), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert len(turn.samples) == samples
    assert turn.longest_silence_ns / MS == pytest.approx(silence_ms, abs=40)


def test_single_sample_is_dropped() -> None:
    """A replayed timestamp has nothing to be inconsistent with."""

    def played_back(exchange: Exchange) -> None:
        if exchange.number > 1:
            exchange.received = False
        if exchange.number == 2:
            exchange.replies.append((TimeReply(OFFSET_NS - 10**15).to_bytes(), FORWARD_NS + 100 * MS))

    link, turn = Link(played_back), Synchronisation(1, 5, TIMING)
    link.run(turn)
    assert turn.samples == []
    assert turn.has_reply


@pytest.mark.parametrize("asked", [b"s1", b"e1"])
def test_restart_drops_earlier_samples(asked: bytes) -> None:
    """A station that has replied to pings and has no timestamp is a restarted program, whatever its clock shows."""

    def modify(exchange: Exchange) -> None:
        if link.sent.count(b"e1") == 3 and exchange.payload == asked and link.station is before:
            exchange.received = False
            link.station = ClassicStation(1)
            link.offset_ns += MS

    link, turn = Link(modify), Synchronisation(1, 5, TIMING)
    before = link.station
    link.run(turn)
    assert turn.restarted
    assert len(turn.samples) >= 3
    assert set(_offsets_ns(turn)) == {OFFSET_NS + MS}


def test_missing_timestamp_before_the_first_ping_is_no_restart() -> None:
    """The first ping was lost; pings before this synchronisation do not count."""

    def modify(exchange: Exchange) -> None:
        exchange.received = exchange.number != 1

    link, turn = Link(modify), Synchronisation(1, 3, TIMING)
    link.run(turn)
    assert not turn.restarted
    assert len(turn.samples) == 2
