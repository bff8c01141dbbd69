from __future__ import annotations

import asyncio
from contextlib import aclosing, asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from harness.radio.plain_radio import AIRTIME_NS, PlainRadio

from tsgt.radio.ping import Exchange, Response, SignalStrength, ping, respond, summarise, summarise_responses
from tsgt.simulation.kernel import VirtualClock

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from tsgt.radio import Radio

TIMEOUT_NS = 200_000_000


async def test_every_request_has_a_reply() -> None:
    """Three requests, three replies, in order, each after the airtime of the reply."""
    async with _pair() as (here, _):
        exchanges = await _ping(here, count=3)
    assert [exchange.number for exchange in exchanges] == [0, 1, 2]
    assert [exchange.round_trip_ns for exchange in exchanges] == [AIRTIME_NS] * 3


async def test_reply_reports_the_signal_strength_of_the_request() -> None:
    """The strengths of both directions arrive, to a tenth of a dBm and a quarter of a dB."""
    async with _pair() as (here, _):
        (exchange,) = await _ping(here, count=1)
    assert exchange.reply is not None
    assert exchange.reply.local == SignalStrength(-80.0, 7.25)
    assert exchange.reply.remote == SignalStrength(-101.3, -11.5)


async def test_reply_reports_the_previous_turnaround() -> None:
    """The turnaround arrives with the next reply; the first reply has none."""
    async with _pair(think_ns=3_000_000) as (here, _):
        exchanges = await _ping(here, count=3)
    turnarounds_ns = [exchange.reply and exchange.reply.previous_turnaround_ns for exchange in exchanges]
    assert turnarounds_ns == [None, 3_000_000, 3_000_000]
    assert summarise(exchanges).turnaround_ns == (3_000_000, 3_000_000)


async def test_new_session_starts_without_a_turnaround() -> None:
    """The turnaround of the last reply to another session is not reported."""
    async with _pair() as (here, _):
        await _ping(here, count=2, session=1)
        (exchange,) = await _ping(here, count=1, session=2)
    assert exchange.reply is not None
    assert exchange.reply.previous_turnaround_ns is None


async def test_packets_are_padded_to_the_requested_length() -> None:
    """Request and reply have the airtime of the payload under test."""
    lengths = []
    async with _pair(on_air=lambda payload: lengths.append(len(payload))) as (here, _):
        await _ping(here, count=1, payload_bytes=40)
    assert lengths == [40, 40]


async def test_lost_reply_times_out() -> None:
    """Without a reply the next request is sent after the timeout."""
    here = PlainRadio(VirtualClock(0))
    exchanges = await _ping(here, count=2)
    assert [exchange.reply for exchange in exchanges] == [None, None]
    assert exchanges[1].started_at_ns == exchanges[0].sent_at_ns + TIMEOUT_NS
    assert summarise(exchanges).loss == 1.0


async def test_late_reply_is_counted_as_late() -> None:
    """A reply to an earlier request does not count for the next one."""
    async with _pair(think_ns=TIMEOUT_NS) as (here, _):
        first, second = await _ping(here, count=2)
    assert first.reply is None
    assert second.late == 1


async def test_repeated_reply_is_counted_as_late() -> None:
    """An echo of a reply is counted as late."""
    async with _pair() as (here, there):
        there.on_sent = here.deliver_twice
        exchanges = await _ping(here, count=2)
    assert [exchange.reply is not None for exchange in exchanges] == [True, True]
    assert [exchange.late for exchange in exchanges] == [0, 1]


async def test_unknown_packets_are_ignored_and_counted() -> None:
    """Short packets, long ones and replies to another session have no effect."""
    other = PlainRadio(VirtualClock(0))
    async with _pair() as (here, there):
        there.on_sent, to_here = other.deliver, there.on_sent
        await _ping(here, count=1, session=8)
        there.on_sent = to_here
        for payload in (b"t1", bytes(34), (await other.receive()).payload, b"\xa5!"):
            here.deliver(payload)
        (exchange,) = await _ping(here, count=1, session=7)
    assert exchange.reply is not None
    assert exchange.unknown == 4


async def test_unknown_packets_do_not_extend_the_timeout() -> None:
    """A busy channel does not delay the next request."""
    here = PlainRadio(VirtualClock(0))

    async def chatter() -> None:
        while True:
            await asyncio.sleep(0.15)
            here.deliver(b"chatter")

    busy = asyncio.create_task(chatter())
    first, second = await _ping(here, count=2)
    busy.cancel()
    await asyncio.wait([busy])
    assert second.started_at_ns - first.sent_at_ns == TIMEOUT_NS


async def test_repeated_request_has_one_reply() -> None:
    """A repeated request, as from an echo, has no second reply."""
    sent: list[bytes] = []
    there, requests = PlainRadio(VirtualClock(0)), PlainRadio(VirtualClock(0))
    there.on_sent = sent.append
    requests.on_sent = there.deliver_twice
    answers: list[Response] = []
    answering = asyncio.create_task(_collect(there, answers))
    await _ping(requests, count=1)
    there.deliver(b"t1")
    await asyncio.sleep(1)
    answering.cancel()
    await asyncio.wait([answering])
    assert len(sent) == 1
    assert [(each.number, each.turnaround_ns is not None) for each in answers] == [
        (0, True),
        (0, False),
        (None, False),
    ]
    summary = summarise_responses(answers)
    assert (summary.replied, summary.repeated, summary.unknown) == (1, 1, 1)


async def test_packet_rate_counts_both_ways() -> None:
    """Ten exchanges of two packets of 50 ms each are twenty packets in a second."""
    async with _pair() as (here, _):
        exchanges = await _ping(here, count=10)
    assert summarise(exchanges).packets_per_s == pytest.approx(20.0)


def test_empty_session_has_no_statistics() -> None:
    """A session that was stopped before its first request has an empty summary."""
    summary = summarise([])
    assert (summary.sent, summary.received, summary.loss, summary.packets_per_s) == (0, 0, None, None)
    assert summarise_responses([]).turnaround_ns is None


async def _ping(radio: Radio, *, count: int, session: int = 7, payload_bytes: int = 34) -> list[Exchange]:
    requests = ping(
        radio,
        VirtualClock(0),
        session=session,
        count=count,
        payload_bytes=payload_bytes,
        timeout_ns=TIMEOUT_NS,
    )
    async with aclosing(requests) as exchanges:
        return [exchange async for exchange in exchanges]


async def _collect(radio: Radio, answers: list[Response]) -> None:
    async with aclosing(respond(radio)) as results:
        async for result in results:
            answers.append(result)  # noqa: PERF401 (it is cancelled, and has to leave what it has)


@asynccontextmanager
async def _pair(
    *, think_ns: int = 0, on_air: Callable[[bytes], None] = lambda _: None
) -> AsyncIterator[tuple[PlainRadio, PlainRadio]]:
    """Make two radios within range of each other, the second responding after ``think_ns``."""
    clock = VirtualClock(0)
    here, there = PlainRadio(clock), PlainRadio(clock, rssi_dbm=-101.3, snr_db=-11.5, latency_ns=think_ns)

    def carry(radio: PlainRadio, payload: bytes) -> None:
        on_air(payload)
        radio.deliver(payload)

    here.on_sent = lambda payload: carry(there, payload)
    there.on_sent = lambda payload: carry(here, payload)
    answering = asyncio.create_task(_collect(there, []))
    try:
        yield here, there
    finally:
        answering.cancel()
        await asyncio.wait([answering])
