"""Transport: sends a transaction's requests and passes replies with their instants."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest
from harness.hardware.radios import MS, PAPER, Bench, bench
from harness.missions.field import TRUE

from tsgt.clock import UnixTimeline
from tsgt.errors import RadioError
from tsgt.master.classic import Transport
from tsgt.radio.classic import LinkTiming, Request, Transaction

if TYPE_CHECKING:
    from collections.abc import Sequence

TIMING = LinkTiming(PAPER, 250 * MS)
TIMELINE = UnixTimeline(1000)


@dataclass
class ScriptedTransaction(Transaction):
    """A transaction that sends requests and accepts replies that begin with one letter."""

    requests: list[Request]
    station: int = 1
    accepted: list[tuple[bytes, int, int, bool]] = field(default_factory=list)
    refused: list[bytes] = field(default_factory=list)
    timeouts: int = 0

    def request(self) -> Request | None:
        """Send the next one."""
        return self.requests.pop(0) if self.requests else None

    def accept_reply(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:
        """Accept payloads that begin with e."""
        if payload[:1] != b"e":
            self.refused.append(payload)
            return False
        self.accepted.append((payload, sent_ns, received_ns, exact))
        return True

    def timed_out(self) -> None:
        """Count it."""
        self.timeouts += 1


def transport_on(both: Bench) -> Transport:
    """Return a transport on the bench's first radio."""
    return Transport(both.here.radio, both.clock, TIMELINE, TIMING)


async def answer(both: Bench, replies: Sequence[tuple[int, bytes]]) -> None:
    """Send replies with the other radio, each with its delay in ms after the request."""
    packet = await both.there.radio.receive()
    for after_ms, payload in replies:
        await both.there.radio.transmit(payload, at_ns=packet.received_at_ns + after_ms * MS)


async def test_instants_are_those_of_the_transmission() -> None:
    """The request starts at its TxDone minus lag and airtime; the reply ends at its RxDone."""
    async with bench() as both:
        task = asyncio.create_task(answer(both, [(1, b"e1")]))
        transaction, transport = ScriptedTransaction([Request(b"e1", 250 * MS)]), transport_on(both)
        began_ns = both.clock.monotonic_ns()
        await transport.run(transaction)
        await task
    ((payload, sent_ns, received_ns, exact),) = transaction.accepted
    assert payload == b"e1"
    assert exact
    assert sent_ns - 1000 - began_ns == pytest.approx(0, abs=MS)
    both_ways_ns = 2 * (TIMING.airtime_ns(2) + TIMING.rx_done_ns) + MS
    assert received_ns - sent_ns == pytest.approx(both_ways_ns, abs=200_000)
    assert transport.last is not None
    assert transport.last.payload == b"e1"
    assert transport.requested_ns == sent_ns


async def test_missing_reply_is_a_timeout() -> None:
    """It counts from the end of the transmission."""
    async with bench() as both:
        transaction = ScriptedTransaction([Request(b"e1", 250 * MS)])
        began_ns = both.clock.monotonic_ns()
        await transport_on(both).run(transaction)
        took_ns = both.clock.monotonic_ns() - began_ns
    assert transaction.timeouts == 1
    assert took_ns == pytest.approx(TIMING.airtime_ns(2) + 250 * MS, abs=MS)


async def test_request_without_reply_does_not_wait() -> None:
    """Request without reply does not wait."""
    async with bench() as both:
        transaction = ScriptedTransaction([Request(b"p1", 0), Request(b"c1", 0)])
        began_ns = both.clock.monotonic_ns()
        await transport_on(both).run(transaction)
        took_ns = both.clock.monotonic_ns() - began_ns
    assert transaction.timeouts == 0
    assert took_ns == pytest.approx(2 * TIMING.airtime_ns(2), abs=2 * MS)


async def test_each_request_is_told() -> None:
    """A synchronisation is many of them, and lasts minutes with slow modem settings: progress is counted by request."""
    async with bench() as both:
        told_ns: list[int] = []
        transport = Transport(
            both.here.radio,
            both.clock,
            TIMELINE,
            TIMING,
            on_request=lambda: told_ns.append(both.clock.monotonic_ns()),
        )
        began_ns = both.clock.monotonic_ns()
        await transport.run(ScriptedTransaction([Request(b"e1", 250 * MS), Request(b"e2", 250 * MS)]))
    period_ns = TIMING.airtime_ns(2) + 250 * MS
    assert [at_ns - began_ns for at_ns in told_ns] == pytest.approx([0, period_ns], abs=2 * MS)


async def test_unrelated_packets_are_counted() -> None:
    """Waiting continues."""
    async with bench() as both:
        task = asyncio.create_task(answer(both, [(1, b"x"), (80, b"e1")]))
        transaction, transport = ScriptedTransaction([Request(b"e1", 250 * MS)]), transport_on(both)
        await transport.run(transaction)
        await task
    assert transaction.refused == [b"x"]
    assert len(transaction.accepted) == 1
    assert transport.unrelated_packets == 1


async def test_packet_before_the_request_is_no_reply() -> None:
    """It is a late reply to the previous transaction."""
    async with bench() as both:
        await both.there.radio.transmit(b"e1")
        await asyncio.sleep(0.1)
        transaction, transport = ScriptedTransaction([Request(b"e1", 250 * MS)]), transport_on(both)
        await transport.run(transaction)
    assert transaction.accepted == []
    assert transaction.timeouts == 1
    assert transport.unrelated_packets == 1


async def test_lost_edge_makes_an_inexact_stamp() -> None:
    """The reply was found by polling."""
    async with bench() as both:

        async def answer_without_edge() -> None:
            packet = await both.there.radio.receive()
            both.here.hal.drop_edges(1)
            await both.there.radio.transmit(b"e1", at_ns=packet.received_at_ns + MS)

        task = asyncio.create_task(answer_without_edge())
        transaction = ScriptedTransaction([Request(b"e1", 250 * MS)])
        await transport_on(both).run(transaction)
        await task
    assert [exact for *_, exact in transaction.accepted] == [False]


async def test_packet_in_time_counts_when_the_program_is_late() -> None:
    """The event loop was blocked beyond the time-out."""
    async with bench() as both:
        task = asyncio.create_task(answer(both, [(1, b"e1")]))
        transaction = ScriptedTransaction([Request(b"e1", 250 * MS)])
        loop = asyncio.get_running_loop()
        loop.call_later(0.15, both.timeline.advance, 600 * MS)
        await transport_on(both).run(transaction)
        await task
    assert len(transaction.accepted) == 1
    assert transaction.timeouts == 0


async def test_radio_error_is_raised() -> None:
    """Radio error is raised."""
    async with bench() as both:
        await both.here.radio.close()
        with pytest.raises(RadioError):
            await transport_on(both).run(ScriptedTransaction([Request(b"e1", 250 * MS)]))
    assert TRUE.monotonic_ns() < 1000 * MS
