"""Runs the frames of the superframe over a radio: transmits beacons when they are due, hands replies to the observer."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn, Protocol

from tsgt.master.classic import next_packet

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.clock import Clock
    from tsgt.radio import Packet, Radio, Transmission
    from tsgt.radio.superframe import ReceivedReply, SuperframeMaster

LEAD_NS = 6_000_000  # a beacon is composed this long before it is due: the radio needs 5 ms of it


class FrameObserver(Protocol):
    """Follows the frames."""

    async def ready(self) -> None:
        """Return when the next frame may be planned."""
        ...

    def composing(self) -> None:
        """Update the acknowledgements: a beacon is about to be composed."""
        ...

    def beacon_sent(self, sent: Transmission) -> None:
        """Take the transmission of the present frame's beacon."""
        ...

    def received(self, reply: ReceivedReply, packet: Packet) -> None:
        """Take a reply and its packet."""
        ...

    def not_received(self, stations: Sequence[int]) -> None:
        """Take the stations whose slots stayed empty in the frame that has ended."""
        ...


class FrameLoop:
    """Runs frames over a started radio that nobody else uses."""

    def __init__(self, radio: Radio, clock: Clock, master: SuperframeMaster, observer: FrameObserver) -> None:
        self._radio = radio
        self._clock = clock
        self._master = master
        self._observer = observer

    async def run(self) -> NoReturn:
        """Run frames until the radio raises RadioError; another loop may continue with the same master."""
        while True:
            await self.frame()

    async def frame(self) -> None:
        """Run one frame, from its planning to the end of its last slot; raises as :meth:`run`."""
        await self._observer.ready()
        start_ns = self._master.prepare(self._clock.monotonic_ns())
        await self._clock.sleep_until(start_ns - LEAD_NS)
        self._observer.composing()
        sent = await self._radio.transmit(self._master.compose(), at_ns=start_ns)
        self._master.sent(sent.done_at_ns, sent.stamp_sigma_ns)
        self._observer.beacon_sent(sent)
        while (until_ns := self._master.reply_deadline_ns) is not None:
            packet = await next_packet(self._radio, self._clock, until_ns)
            if packet is None:
                break
            reply = self._master.received(packet.payload, packet.received_at_ns, packet.stamp_sigma_ns)
            if reply is not None:
                self._observer.received(reply, packet)
        self._observer.not_received(self._master.finish())
