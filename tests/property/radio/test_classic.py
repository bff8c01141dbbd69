"""The classic protocol survives any packet, and its messages round-trip."""

from __future__ import annotations

import math
from typing import cast, get_args

import pytest
from harness.files.damage import examples
from harness.hardware.radios import MS, PAPER
from hypothesis import given
from hypothesis import strategies as st

from tsgt.model import Status
from tsgt.radio import MeasureCommand
from tsgt.radio.classic import (
    ClassicStation,
    CommandMessage,
    CommandTransaction,
    LinkTiming,
    MeasurementMessage,
    Poll,
    SingleMeasurementPoll,
    Synchronisation,
    Transaction,
    decode_command,
    status_of,
)
from tsgt.radio.classic.messages import (
    MAX_TIME_NS,
    Acknowledgement,
    Letter,
    PingReply,
    TimeReply,
    decode_reply,
    no_measurement_yet,
)

TIMING = LinkTiming(PAPER, 250 * MS)

stations = st.integers(1, 9)
times_ns = st.integers(0, MAX_TIME_NS)
angles_rad = st.floats(-4 * math.pi, 4 * math.pi)
commands = st.one_of(
    st.builds(CommandMessage, st.sampled_from(cast("tuple[Letter, ...]", get_args(Letter))), stations),
    st.builds(CommandMessage, st.just("n"), stations, st.integers(1, 9)),
)
measurements = st.builds(
    MeasurementMessage,
    station=stations,
    status=st.sampled_from([0, 4]),
    zenith_angle_rad=angles_rad,
    horizontal_angle_rad=angles_rad,
    slope_distance_m=st.floats(0, 20_000),
    time_ns=times_ns,
)
replies = st.one_of(
    st.builds(PingReply, stations),
    st.builds(TimeReply, times_ns),
    st.builds(Acknowledgement, st.sampled_from(["d", "n"]), st.booleans()),
    measurements,
)
# Bytes that come near to being a message, too.
packets = st.one_of(
    st.binary(max_size=40),
    st.binary(min_size=34, max_size=34),
    st.binary(min_size=32, max_size=32).map(lambda rest: b"\x01\x00" + rest),
    st.binary(min_size=8, max_size=8).map(lambda rest: b"s" + rest),
    commands.map(CommandMessage.to_bytes),
    replies.map(lambda reply: reply.to_bytes()),
)


@given(commands)
def test_commands_round_trip(command: CommandMessage) -> None:
    """Decoding inverts encoding."""
    assert decode_command(command.to_bytes()) == command


@given(replies)
def test_replies_round_trip(reply: PingReply | TimeReply | Acknowledgement | MeasurementMessage) -> None:
    """Decoding inverts encoding, to the last bit of a number."""
    assert decode_reply(reply.to_bytes()) == reply


@given(packets)
def test_any_packet_decodes_or_is_rejected(payload: bytes) -> None:
    """A decoded packet would be encoded the same; all its numbers are finite."""
    command, reply = decode_command(payload), decode_reply(payload)
    if command is not None:
        assert command.to_bytes() == payload
    if reply is not None and not (
        isinstance(reply, MeasurementMessage) and status_of(reply) is not Status.OK
    ):
        assert reply.to_bytes() == payload
    if isinstance(reply, MeasurementMessage):
        numbers = (reply.zenith_angle_rad, reply.horizontal_angle_rad, reply.slope_distance_m)
        assert all(map(math.isfinite, numbers))
        assert 0 <= reply.time_ns <= MAX_TIME_NS


@given(st.lists(st.tuples(packets, st.integers(0, 3)), max_size=40))
def test_station_survives_any_packet(events: list[tuple[bytes, int]]) -> None:
    """For any packets, each command is issued once, and each reply is valid."""
    station = ClassicStation(1)
    under_way = None
    for payload, patience in events:
        answer = station.received(payload, 5)
        if isinstance(answer, bytes):
            assert decode_reply(answer) is not None
        elif answer is not None:
            assert under_way is None
            under_way = answer
        if under_way is not None and not patience:
            if isinstance(under_way, MeasureCommand):
                station.single_measured(no_measurement_yet(1))
            else:
                assert decode_reply(station.executed(under_way, ok=len(payload) % 2 == 0)) is not None
            under_way = None


@examples(300)
@given(
    turn=st.sampled_from(["poll", "shot", "order", "synchronisation"]),
    answers=st.lists(st.lists(st.tuples(packets, st.integers(54 * MS, 300 * MS)), max_size=3), max_size=60),
)
@pytest.mark.slow
def test_every_transaction_ends(turn: str, answers: list[list[tuple[bytes, int]]]) -> None:
    """For any replies, a transaction sends a bounded number of requests, all to its own station."""
    turns: dict[str, Transaction] = {
        "poll": Poll(1, TIMING),
        "shot": SingleMeasurementPoll(1, TIMING),
        "order": CommandTransaction(1, CommandMessage("n", 1, 2), 2000 * MS),
        "synchronisation": Synchronisation(1, 5, TIMING),
    }
    subject = turns[turn]
    sent_ns, asked = 0, 0
    while (request := subject.request()) is not None:
        asked += 1
        assert asked <= 60
        assert request.payload[1:2] == b"1"
        sent_ns += 400 * MS
        if request.reply_timeout_ns:
            came = answers.pop(0) if answers else []
            if not any(
                subject.accept_reply(payload, sent_ns=sent_ns, received_ns=sent_ns + after_ns, exact=True)
                for payload, after_ns in came
            ):
                subject.timed_out()


@pytest.mark.slow
@examples(300)
@given(data=st.data(), cycles=st.integers(1, 12))
def test_late_and_lost_packets_never_make_a_wrong_sample(data: st.DataObject, cycles: int) -> None:
    """With a station that replies in order, however late, over a lossy link, each sample's bounds hold."""
    offset_ns = 10**18
    station = ClassicStation(1)
    turn = Synchronisation(1, cycles, TIMING)
    flying: list[tuple[int, bytes]] = []  # replies and their RxDone, in order
    sending_ns: list[tuple[int, int]] = []  # when the station sends and cannot receive
    now_ns = 0
    free_at_ns = 0  # the station's program; what comes before waits in its radio
    while (request := turn.request()) is not None:
        sent_ns, now_ns = now_ns, now_ns + TIMING.airtime_ns(2)
        received_ns = now_ns + TIMING.rx_done_ns
        busy = any(start_ns < received_ns and sent_ns < end_ns for start_ns, end_ns in sending_ns)
        if not busy and data.draw(st.sampled_from([True] * 6 + [False])):
            reply = station.received(request.payload, received_ns + offset_ns)
            think_ms = data.draw(st.sampled_from([1, 1, 1, 50, 200, 300, 600]))
            free_at_ns = max(free_at_ns, received_ns) + think_ms * MS
            if isinstance(reply, bytes):
                start_ns, free_at_ns = free_at_ns, free_at_ns + TIMING.airtime_ns(len(reply))
                sending_ns.append((start_ns, free_at_ns))
                if data.draw(st.sampled_from([True] * 6 + [False])):
                    flying.append((free_at_ns + TIMING.rx_done_ns, reply))
        if not request.reply_timeout_ns:
            continue
        deadline_ns = now_ns + request.reply_timeout_ns
        # The master cannot receive while it sends.
        flying = [(at_ns, reply) for at_ns, reply in flying if at_ns > now_ns]
        accepted = False
        while flying and flying[0][0] <= deadline_ns and not accepted:
            at_ns, reply = flying.pop(0)
            accepted = turn.accept_reply(reply, sent_ns=sent_ns, received_ns=at_ns, exact=True)
            now_ns = at_ns
        if not accepted:
            now_ns = deadline_ns
            turn.timed_out()
    for sample in turn.samples:
        assert sample.station_ns - offset_ns == sample.sent_ns + sample.forward_ns
        assert sample.excess_ns >= 0
