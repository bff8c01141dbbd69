from __future__ import annotations

import pytest
from harness.hardware.radios import MS, PAPER

from tsgt.radio import TX_DONE_NS, LoRaSettings
from tsgt.radio.classic import (
    CommandMessage,
    CommandTransaction,
    LinkTiming,
    MeasurementMessage,
    Poll,
    Request,
    SingleMeasurementPoll,
    Transaction,
)

TIMING = LinkTiming(PAPER, 250 * MS)
SOME = MeasurementMessage(
    station=1,
    status=0,
    zenith_angle_rad=1.5,
    horizontal_angle_rad=2.0,
    slope_distance_m=50.0,
    time_ns=1_000_000_007,
)


def test_timing_of_the_paper() -> None:
    """At SF 9 the airtimes are those of the paper, and 250 ms suffice for every reply."""
    assert [TIMING.airtime_ns(size) for size in (2, 9, 34)] == [53_760_000, 78_336_000, 139_776_000]
    assert [TIMING.timeout_ns(size) for size in (2, 9, 34)] == [250 * MS] * 3
    assert TX_DONE_NS == 67_000
    assert TIMING.rx_done_ns == pytest.approx(0.76 * 2.048e6, abs=1)


@pytest.mark.parametrize("spreading_factor", [10, 11, 12])
def test_timeout_follows_the_airtime(spreading_factor: int) -> None:
    """Where a measurement lasts 250 ms and more, the timeout exceeds it."""
    settings = LoRaSettings(
        frequency_hz=905_000_000, spreading_factor=spreading_factor, bandwidth_hz=250_000, coding_rate=6
    )
    timing = LinkTiming(settings, 250 * MS)
    assert timing.timeout_ns(34) >= timing.airtime_ns(34) + timing.rx_done_ns + 100 * MS


def test_poll_sends_one_request() -> None:
    """After one request and its reply the poll is over."""
    poll = Poll(1, TIMING)
    assert poll.request() == Request(b"t1", 250 * MS)
    assert not poll.has_reply
    assert _reply(poll, SOME.to_bytes())
    assert (poll.has_reply, poll.message, poll.request()) == (True, SOME, None)


def test_poll_without_a_reply_is_over() -> None:
    """The scheduler repeats it."""
    poll = Poll(1, TIMING)
    poll.request()
    poll.timed_out()
    assert (poll.has_reply, poll.request()) == (False, None)


@pytest.mark.parametrize(
    "payload", [b"e1", b"dOk", bytes(34), b"\x02" + SOME.to_bytes()[1:], SOME.to_bytes()[:-1]]
)
def test_poll_accepts_only_its_own_station(payload: bytes) -> None:
    """Other replies, unknown packets and the measurement of another station are not its reply."""
    poll = Poll(1, TIMING)
    poll.request()
    assert not _reply(poll, payload)
    assert not poll.has_reply


def test_single_measurement_has_its_own_timeout() -> None:
    """The instrument takes seconds; the timeout is longer than that."""
    shot = SingleMeasurementPoll(1, TIMING, 20_000 * MS)
    request = shot.request()
    assert request is not None
    assert (request.payload, request.reply_timeout_ns) == (b"t1", 20_250 * MS)
    assert _reply(shot, SOME.to_bytes())
    assert shot.message == SOME


@pytest.mark.parametrize(
    ("order", "payload", "ok"),
    [
        (CommandMessage("d", 1), b"dOk", True),
        (CommandMessage("d", 1), b"dNo", False),
        (CommandMessage("n", 1, 3), b"nOk", True),
        (CommandMessage("n", 1), b"nNo", False),
    ],
)
def test_command_is_acknowledged(order: CommandMessage, payload: bytes, *, ok: bool) -> None:
    """A command ends any synchronisation first, and takes its acknowledgement."""
    turn = CommandTransaction(1, order, 2_000 * MS)
    assert turn.request() == Request(b"c1", 0)
    assert turn.request() == Request(order.to_bytes(), 2_000 * MS)
    assert _reply(turn, payload)
    assert turn.request() is None
    assert turn.ok is ok


@pytest.mark.parametrize("payload", [b"nOk", b"nNo", b"d1", SOME.to_bytes()])
def test_command_accepts_only_its_own_acknowledgement(payload: bytes) -> None:
    """The late acknowledgement of the other command is not accepted."""
    turn = CommandTransaction(1, CommandMessage("d", 1), 2_000 * MS)
    turn.request()
    turn.request()
    assert not _reply(turn, payload)
    turn.timed_out()
    assert (turn.ok, turn.request()) == (None, None)


def _reply(turn: Transaction, payload: bytes) -> bool:
    return turn.accept_reply(payload, sent_ns=0, received_ns=200 * MS, exact=True)
