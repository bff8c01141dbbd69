"""Carries the transactions of the classic protocol over a radio; :mod:`tsgt.radio.classic` decides what they send."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from tsgt.radio import TX_DONE_NS

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.radio import Packet, Radio
    from tsgt.radio.classic import LinkTiming, Transaction

EXACT_SIGMA_NS = 1_000_000
"""RPi.GPIO's edges have this; the stamp of a packet whose edge was lost is tens of times worse."""


class Transport:
    """Runs transactions over a radio, one at a time; ``on_request`` is called before each request.

    Attributes
    ----------
    last
        The last reply; None before the first one.
    requested_ns
        When the transmission of the last request began, on the master's Unix clock in ns.
    unrelated_packets
        Packets that were not the expected reply: interference, late replies, damaged packets.
    """

    def __init__(
        self,
        radio: Radio,
        clock: Clock,
        timeline: UnixTimeline,
        timing: LinkTiming,
        *,
        on_request: Callable[[], None] = lambda: None,
    ) -> None:
        self._radio = radio
        self._clock = clock
        self._timeline = timeline
        self._timing = timing
        self._on_request = on_request
        self.last: Packet | None = None
        self.requested_ns = 0
        self.unrelated_packets = 0

    async def run(self, transaction: Transaction) -> None:
        """Run a transaction to its end, or until the radio raises RadioError."""
        while (request := transaction.request()) is not None:
            self._on_request()
            sent = await self._radio.transmit(request.payload)
            if not request.reply_timeout_ns:
                continue
            # Computed back from TxDone, which has an interrupt edge; the start of a transmission has none.
            airtime_ns = self._timing.airtime_ns(len(request.payload))
            self.requested_ns = self._timeline.unix_ns(sent.done_at_ns - TX_DONE_NS - airtime_ns)
            deadline_ns = sent.done_at_ns + request.reply_timeout_ns
            while (packet := await next_packet(self._radio, self._clock, deadline_ns)) is not None:
                # A packet from before the end of the request is a reply to an earlier one.
                if packet.received_at_ns > sent.done_at_ns and transaction.accept_reply(
                    packet.payload,
                    sent_ns=self.requested_ns,
                    received_ns=self._timeline.unix_ns(packet.received_at_ns),
                    exact=max(sent.stamp_sigma_ns, packet.stamp_sigma_ns) <= EXACT_SIGMA_NS,
                ):
                    self.last = packet
                    break
                self.unrelated_packets += 1
            else:
                transaction.timed_out()


async def next_packet(radio: Radio, clock: Clock, deadline_ns: int) -> Packet | None:
    """Return the next packet; None when there is none by a monotonic instant."""
    # Check again without waiting: this task may wake up late, and a packet may have arrived meanwhile.
    for wait_ns in (max(0, deadline_ns - clock.monotonic_ns()), 0):
        with suppress(TimeoutError):
            async with asyncio.timeout(wait_ns / 1e9):
                return await radio.receive()
    return None
