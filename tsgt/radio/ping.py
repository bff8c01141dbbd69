"""A bench test of two radios: one sends requests, the other answers each at once.

A request is a tag, the run's number and its own number, filled up to the length asked for. A reply is as long, and
tells besides how the request was heard and how long the reply before it took: a reply cannot tell of itself when it
started. All numbers are little-endian.
"""

from __future__ import annotations

import asyncio
import struct
from contextlib import suppress
from dataclasses import dataclass
from statistics import fmean, median
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterable

    from tsgt.clock import Clock
    from tsgt.radio.base import Packet, Radio

# The first byte is no ASCII letter, as the first of each message of the authors' nodes is.
_REQUEST, _REPLY = b"\xa5?", b"\xa5!"
_HEADER = struct.Struct("<2sHH")  # tag, run, number
_REPORT = struct.Struct("<Ihb")  # previous turn-round in us, RSSI in tenths of dBm, SNR in quarters of dB
_NO_TURN_ROUND = 0xFFFFFFFF

MIN_PAYLOAD_BYTES = _HEADER.size + _REPORT.size
"""What a reply has to hold."""

RUNS = 1 << 16
"""Runs are numbered from 0 to one below this."""


class Strength(NamedTuple):
    """How a packet was heard."""

    rssi_dbm: float
    snr_db: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What came back.

    Attributes
    ----------
    received_at_ns
        RxDone of the reply, CLOCK_MONOTONIC.
    here, there
        How the reply was heard here, and the request at the other radio.
    previous_turn_round_ns
        From RxDone of a request to the start of its reply, both by the other machine's clock; of the reply that it
        sent before this one. None where this is its first.
    """

    received_at_ns: int
    here: Strength
    there: Strength
    previous_turn_round_ns: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchange:
    """One request and what came of it.

    Attributes
    ----------
    number
        Of the request, from 0.
    started_at_ns, sent_at_ns
        Start and TxDone of the request, CLOCK_MONOTONIC.
    reply
        None where none came in time.
    late, foreign
        How many replies to earlier requests (or second ones), and how many packets of others came meanwhile.
    """

    number: int
    started_at_ns: int
    sent_at_ns: int
    reply: Reply | None
    late: int
    foreign: int

    @property
    def round_trip_ns(self) -> int | None:
        """From TxDone of the request to RxDone of the reply."""
        return None if self.reply is None else self.reply.received_at_ns - self.sent_at_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What the answering side did with a packet.

    Attributes
    ----------
    number
        Of the request; None where the packet was another's.
    heard
        How it was heard.
    turn_round_ns
        From its RxDone to the start of the reply; None where there was none: a request is answered once.
    """

    number: int | None
    heard: Strength
    turnaround_ns: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """What a run of requests has come to; None stands where there was nothing to count.

    Attributes
    ----------
    sent, received
        Requests, and replies that came in time.
    late, foreign
        As in :class:`Exchange`, added up.
    packets_per_s
        Packets of complete exchanges, both ways, over the time from the first to the last.
    here, there
        Mean strength of the replies here, and of the requests at the other radio.
    round_trip_ns, turn_round_ns
        Median and longest.
    """

    sent: int
    received: int
    late: int
    foreign: int
    packets_per_s: float | None
    here: Strength | None
    there: Strength | None
    round_trip_ns: tuple[int, int] | None
    turnaround_ns: tuple[int, int] | None

    @property
    def loss(self) -> float | None:
        """Share of the requests that no reply came to, 0 to 1."""
        return 1 - self.received / self.sent if self.sent else None


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerSummary:
    """What the answering side has come to; None stands where there was nothing to count.

    Attributes
    ----------
    answered, repeated, foreign
        Requests that were answered, requests that came again, packets of others.
    heard
        Mean strength of the answered requests.
    turn_round_ns
        Median and longest.
    """

    answered: int
    repeated: int
    foreign: int
    heard: Strength | None
    turnaround_ns: tuple[int, int] | None


async def ping(
    radio: Radio, clock: Clock, *, run: int, count: int, payload_bytes: int, timeout_ns: int
) -> AsyncGenerator[Exchange, None]:
    """Send requests one after the other and yield what came of each.

    Parameters
    ----------
    radio
        Started.
    clock
        The radio's.
    run
        Number of this run, below :data:`RUNS`, by chance, so that replies to another run do not count.
    count
        How many requests, at most 65536.
    payload_bytes
        Length of request and reply, :data:`MIN_PAYLOAD_BYTES` to 255.
    timeout_ns
        From TxDone of a request until its reply is given up.

    Raises
    ------
    RadioError
        The radio failed.
    """
    for number in range(count):
        sent = await radio.transmit(_HEADER.pack(_REQUEST, run, number).ljust(payload_bytes, b"\0"))
        reply: Reply | None = None
        late = foreign = 0
        with suppress(TimeoutError):
            async with asyncio.timeout(max(0, sent.done_at_ns + timeout_ns - clock.monotonic_ns()) / 1e9):
                while reply is None:
                    packet = await radio.receive()
                    header = _header(packet, _REPLY)
                    if header is None or header.run != run:
                        foreign += 1
                    elif header.number != number:
                        late += 1
                    else:
                        reply = _reply(packet)
        yield Exchange(
            number=number,
            started_at_ns=sent.started_at_ns,
            sent_at_ns=sent.done_at_ns,
            reply=reply,
            late=late,
            foreign=foreign,
        )


async def answer(radio: Radio) -> AsyncGenerator[Answer, None]:
    """Answer requests until cancelled and yield what was done with each packet.

    Raises
    ------
    RadioError
        The radio failed.
    """
    previous: _Header | None = None
    turnaround_us = _NO_TURN_ROUND
    while True:
        packet = await radio.receive()
        heard = Strength(packet.rssi_dbm, packet.snr_db)
        header = _header(packet, _REQUEST)
        if header is None or header == previous:
            yield Answer(number=header and header.number, heard=heard, turnaround_ns=None)
            continue
        if previous is None or header.run != previous.run:
            turnaround_us = _NO_TURN_ROUND
        previous = header
        report = _REPORT.pack(turnaround_us, round(heard.rssi_dbm * 10), round(heard.snr_db * 4))
        reply = _HEADER.pack(_REPLY, header.run, header.number) + report
        sent = await radio.transmit(reply.ljust(len(packet.payload), b"\0"))
        turnaround_ns = sent.started_at_ns - packet.received_at_ns
        turnaround_us = min(turnaround_ns // 1000, _NO_TURN_ROUND - 1)
        yield Answer(number=header.number, heard=heard, turnaround_ns=turnaround_ns)


def summarise(exchanges: Iterable[Exchange]) -> Summary:
    """Put a run into figures."""
    exchanges = list(exchanges)
    answered = [(exchange, exchange.reply) for exchange in exchanges if exchange.reply is not None]
    replies = [reply for _, reply in answered]
    duration_ns = replies[-1].received_at_ns - exchanges[0].started_at_ns if replies else 0
    return Summary(
        sent=len(exchanges),
        received=len(replies),
        late=sum(exchange.late for exchange in exchanges),
        foreign=sum(exchange.foreign for exchange in exchanges),
        packets_per_s=2 * len(replies) / (duration_ns / 1e9) if duration_ns else None,
        here=_mean(reply.here for reply in replies),
        there=_mean(reply.there for reply in replies),
        round_trip_ns=_median_and_max(
            reply.received_at_ns - exchange.sent_at_ns for exchange, reply in answered
        ),
        turnaround_ns=_median_and_max(
            reply.previous_turn_round_ns for reply in replies if reply.previous_turn_round_ns is not None
        ),
    )


def summarise_answers(answers: Iterable[Answer]) -> AnswerSummary:
    """Put the answering side into figures."""
    answers = list(answers)
    turn_rounds_ns = [each.turnaround_ns for each in answers if each.turnaround_ns is not None]
    foreign = sum(each.number is None for each in answers)
    return AnswerSummary(
        answered=len(turn_rounds_ns),
        repeated=len(answers) - len(turn_rounds_ns) - foreign,
        foreign=foreign,
        heard=_mean(each.heard for each in answers if each.turnaround_ns is not None),
        turnaround_ns=_median_and_max(turn_rounds_ns),
    )


class _Header(NamedTuple):
    run: int
    number: int


def _header(packet: Packet, tag: bytes) -> _Header | None:
    """Run and number of a packet of ours; None for anything else."""
    if len(packet.payload) < MIN_PAYLOAD_BYTES or packet.payload[: len(tag)] != tag:
        return None
    _, run, number = _HEADER.unpack_from(packet.payload)
    return _Header(run, number)


def _reply(packet: Packet) -> Reply:
    turnaround_us, rssi_tenths_dbm, snr_quarters_db = _REPORT.unpack_from(packet.payload, _HEADER.size)
    return Reply(
        received_at_ns=packet.received_at_ns,
        here=Strength(packet.rssi_dbm, packet.snr_db),
        there=Strength(rssi_tenths_dbm / 10, snr_quarters_db / 4),
        previous_turn_round_ns=None if turnaround_us == _NO_TURN_ROUND else turnaround_us * 1000,
    )


def _mean(strengths: Iterable[Strength]) -> Strength | None:
    strengths = list(strengths)
    if not strengths:
        return None
    return Strength(fmean(s.rssi_dbm for s in strengths), fmean(s.snr_db for s in strengths))


def _median_and_max(times_ns: Iterable[int]) -> tuple[int, int] | None:
    times_ns = list(times_ns)
    return (round(median(times_ns)), max(times_ns)) if times_ns else None
