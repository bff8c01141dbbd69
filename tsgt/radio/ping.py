"""A bench test of two radios: one sends requests, the other replies to each at once.

A request is a tag and the numbers of session and request, padded. A reply is as long, and reports how the request was
received and the previous turnaround, as it cannot contain its own. All numbers are little-endian.
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

# The first byte is not an ASCII letter, unlike that of each message of the authors' nodes.
_REQUEST, _REPLY = b"\xa5?", b"\xa5!"
_HEADER = struct.Struct("<2sHH")  # tag, session, number
_REPORT = struct.Struct("<Ihb")  # previous turnaround in us, RSSI in tenths of dBm, SNR in quarters of dB
_NO_TURNAROUND = 0xFFFFFFFF

MIN_PAYLOAD_BYTES = _HEADER.size + _REPORT.size

SESSION_IDS = 1 << 16  # sessions are numbered from 0 to one below this


class SignalStrength(NamedTuple):
    """RSSI and SNR of a received packet, or their means."""

    rssi_dbm: float
    snr_db: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """A reply.

    Attributes
    ----------
    received_at_ns
        RxDone, CLOCK_MONOTONIC.
    local, remote
        Of the reply at this radio, and of the request at the other one.
    previous_turnaround_ns
        From RxDone of a request to the start of its reply, both on the other machine's clock; of the reply before this
        one. None for its first.
    """

    received_at_ns: int
    local: SignalStrength
    remote: SignalStrength
    previous_turnaround_ns: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchange:
    """A request and its reply.

    Attributes
    ----------
    number
        From 0.
    started_at_ns, sent_at_ns
        Start and TxDone of the request, CLOCK_MONOTONIC.
    reply
        None without one in time.
    late, unknown
        Replies to earlier requests (or second ones), and unknown packets, meanwhile.
    """

    number: int
    started_at_ns: int
    sent_at_ns: int
    reply: Reply | None
    late: int
    unknown: int

    @property
    def round_trip_ns(self) -> int | None:
        """From TxDone of the request to RxDone of the reply."""
        return None if self.reply is None else self.reply.received_at_ns - self.sent_at_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    """A packet at the responding side.

    ``number``: of the request; None for an unknown packet. ``turnaround_ns``: from its RxDone to the start of the
    reply; None without one: a request has one reply.
    """

    number: int | None
    signal: SignalStrength
    turnaround_ns: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Statistics of a session; None where nothing was counted.

    Attributes
    ----------
    packets_per_s
        Packets of complete exchanges, both ways, over the time from the first to the last.
    local, remote
        Means of the replies here, and of the requests at the other radio.
    round_trip_ns, turnaround_ns
        Median and maximum.
    """

    sent: int
    received: int
    late: int
    unknown: int
    packets_per_s: float | None
    local: SignalStrength | None
    remote: SignalStrength | None
    round_trip_ns: tuple[int, int] | None
    turnaround_ns: tuple[int, int] | None

    @property
    def loss(self) -> float | None:
        """Share of the requests without a reply, 0 to 1."""
        return 1 - self.received / self.sent if self.sent else None


@dataclass(frozen=True, slots=True, kw_only=True)
class ResponderSummary:
    """Statistics of the responding side; None where nothing was counted.

    Attributes
    ----------
    replied, repeated, unknown
        Requests with a reply, repeated requests, unknown packets.
    signal
        Mean of the requests with a reply.
    turnaround_ns
        Median and maximum.
    """

    replied: int
    repeated: int
    unknown: int
    signal: SignalStrength | None
    turnaround_ns: tuple[int, int] | None


async def ping(
    radio: Radio, clock: Clock, *, session: int, count: int, payload_bytes: int, timeout_ns: int
) -> AsyncGenerator[Exchange, None]:
    """Send requests one after the other and yield each exchange.

    Raises RadioError if the radio failed.

    Parameters
    ----------
    session
        Random number below :data:`SESSION_IDS`, so that replies to other sessions do not count.
    count
        Number of requests, at most 65536.
    payload_bytes
        Of request and reply, :data:`MIN_PAYLOAD_BYTES` to 255.
    timeout_ns
        From TxDone of a request to RxDone of its reply.
    """
    for number in range(count):
        sent = await radio.transmit(_HEADER.pack(_REQUEST, session, number).ljust(payload_bytes, b"\0"))
        reply: Reply | None = None
        late = unknown = 0
        with suppress(TimeoutError):
            async with asyncio.timeout(max(0, sent.done_at_ns + timeout_ns - clock.monotonic_ns()) / 1e9):
                while reply is None:
                    packet = await radio.receive()
                    header = _header(packet, _REPLY)
                    if header is None or header.session != session:
                        unknown += 1
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
            unknown=unknown,
        )


async def respond(radio: Radio) -> AsyncGenerator[Response, None]:
    """Reply to requests until cancelled and yield the response to each packet. Raises RadioError if the radio failed."""
    previous: _Header | None = None
    turnaround_us = _NO_TURNAROUND
    while True:
        packet = await radio.receive()
        signal = SignalStrength(packet.rssi_dbm, packet.snr_db)
        header = _header(packet, _REQUEST)
        if header is None or header == previous:
            yield Response(number=header and header.number, signal=signal, turnaround_ns=None)
            continue
        if previous is None or header.session != previous.session:
            turnaround_us = _NO_TURNAROUND
        previous = header
        report = _REPORT.pack(turnaround_us, round(signal.rssi_dbm * 10), round(signal.snr_db * 4))
        reply = _HEADER.pack(_REPLY, header.session, header.number) + report
        sent = await radio.transmit(reply.ljust(len(packet.payload), b"\0"))
        turnaround_ns = sent.started_at_ns - packet.received_at_ns
        turnaround_us = min(turnaround_ns // 1000, _NO_TURNAROUND - 1)
        yield Response(number=header.number, signal=signal, turnaround_ns=turnaround_ns)


def summarise(exchanges: Iterable[Exchange]) -> Summary:
    """Compute the statistics of a session."""
    exchanges = list(exchanges)
    replied = [(exchange, exchange.reply) for exchange in exchanges if exchange.reply is not None]
    replies = [reply for _, reply in replied]
    duration_ns = replies[-1].received_at_ns - exchanges[0].started_at_ns if replies else 0
    return Summary(
        sent=len(exchanges),
        received=len(replies),
        late=sum(exchange.late for exchange in exchanges),
        unknown=sum(exchange.unknown for exchange in exchanges),
        packets_per_s=2 * len(replies) / (duration_ns / 1e9) if duration_ns else None,
        local=_mean(reply.local for reply in replies),
        remote=_mean(reply.remote for reply in replies),
        round_trip_ns=_median_and_max(
            reply.received_at_ns - exchange.sent_at_ns for exchange, reply in replied
        ),
        turnaround_ns=_median_and_max(
            reply.previous_turnaround_ns for reply in replies if reply.previous_turnaround_ns is not None
        ),
    )


def summarise_responses(responses: Iterable[Response]) -> ResponderSummary:
    """Compute the statistics of the responding side."""
    responses = list(responses)
    turnarounds_ns = [each.turnaround_ns for each in responses if each.turnaround_ns is not None]
    unknown = sum(each.number is None for each in responses)
    return ResponderSummary(
        replied=len(turnarounds_ns),
        repeated=len(responses) - len(turnarounds_ns) - unknown,
        unknown=unknown,
        signal=_mean(each.signal for each in responses if each.turnaround_ns is not None),
        turnaround_ns=_median_and_max(turnarounds_ns),
    )


class _Header(NamedTuple):
    session: int
    number: int


def _header(packet: Packet, tag: bytes) -> _Header | None:
    """Decode session and number; None for an unknown packet."""
    if len(packet.payload) < MIN_PAYLOAD_BYTES or packet.payload[: len(tag)] != tag:
        return None
    _, session, number = _HEADER.unpack_from(packet.payload)
    return _Header(session, number)


def _reply(packet: Packet) -> Reply:
    turnaround_us, rssi_tenths_dbm, snr_quarters_db = _REPORT.unpack_from(packet.payload, _HEADER.size)
    return Reply(
        received_at_ns=packet.received_at_ns,
        local=SignalStrength(packet.rssi_dbm, packet.snr_db),
        remote=SignalStrength(rssi_tenths_dbm / 10, snr_quarters_db / 4),
        previous_turnaround_ns=None if turnaround_us == _NO_TURNAROUND else turnaround_us * 1000,
    )


def _mean(strengths: Iterable[SignalStrength]) -> SignalStrength | None:
    strengths = list(strengths)
    if not strengths:
        return None
    return SignalStrength(fmean(s.rssi_dbm for s in strengths), fmean(s.snr_db for s in strengths))


def _median_and_max(times_ns: Iterable[int]) -> tuple[int, int] | None:
    times_ns = list(times_ns)
    return (round(median(times_ns)), max(times_ns)) if times_ns else None
