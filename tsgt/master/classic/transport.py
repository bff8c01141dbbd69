"""Carries the turns of the classic protocol over a radio: sends what a turn asks for, hands it what comes back.

What is sent and what an answer means is decided in :mod:`tsgt.radio.classic.transactions`; here is only the waiting.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsgt.clock import Clock, UnixTimeline
    from tsgt.radio import Packet, Radio
    from tsgt.radio.classic.transactions import LinkTiming, Transaction

EXACT_SIGMA_NS = 1_000_000
"""RPi.GPIO's edges have this; the stamp of a packet that was found without its edge is tens of times worse."""


class Collector:
    """Runs turns over a radio, one at a time.

    Parameters
    ----------
    radio
        Started; nobody else receives from it.
    clock
        The radio's.
    timeline
        Where the turns' instants lie.
    timing
        How long packets last at the settings of the radio.

    Attributes
    ----------
    last
        The answer that came last; None before the first one.
    requested_ns
        When the last request began on the air, on the master's Unix clock in ns.
    foreign
        How many packets were not the answer that was waited for: those of others, late ones, garbage.
    """

    def __init__(self, radio: Radio, clock: Clock, timeline: UnixTimeline, timing: LinkTiming) -> None:
        self._radio = radio
        self._clock = clock
        self._timeline = timeline
        self._timing = timing
        self.last: Packet | None = None
        self.requested_ns = 0
        self.foreign = 0

    async def take(self, turn: Transaction) -> None:
        """Run a turn to its end.

        Raises
        ------
        RadioError
            A request could not be sent; what the turn has collected so far stands.
        """
        while (request := turn.request()) is not None:
            sent = await self._radio.transmit(request.payload)
            if not request.reply_timeout_ns:
                continue
            # From TxDone backwards: that is an interrupt's edge, the start of a transmission is none.
            airtime_ns = self._timing.airtime_ns(len(request.payload))
            self.requested_ns = self._timeline.unix_ns(sent.done_at_ns - self._timing.tx_done_ns - airtime_ns)
            deadline_ns = sent.done_at_ns + request.reply_timeout_ns
            while (packet := await next_packet(self._radio, self._clock, deadline_ns)) is not None:
                # One from before the request went out answers an earlier one.
                if packet.received_at_ns > sent.done_at_ns and turn.replied(
                    packet.payload,
                    sent_ns=self.requested_ns,
                    received_ns=self._timeline.unix_ns(packet.received_at_ns),
                    exact=max(sent.stamp_sigma_ns, packet.stamp_sigma_ns) <= EXACT_SIGMA_NS,
                ):
                    self.last = packet
                    break
                self.foreign += 1
            else:
                turn.timed_out()


async def next_packet(radio: Radio, clock: Clock, deadline_ns: int) -> Packet | None:
    """Wait for a packet until a monotonic instant; None when there is none by then."""
    # Again without waiting: this task may wake up late, with a packet there that was not.
    for wait_ns in (max(0, deadline_ns - clock.monotonic_ns()), 0):
        with suppress(TimeoutError):
            async with asyncio.timeout(wait_ns / 1e9):
                return await radio.receive()
    return None
