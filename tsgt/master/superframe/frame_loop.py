"""Carries the frames of the superframe over a radio: sends beacons when they are due, hands on what comes back.

What is sent and what a reply means is decided in :mod:`tsgt.radio.superframe.master`; here is only the waiting.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn, Protocol

from tsgt.master.classic import next_packet

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.clock import Clock
    from tsgt.radio import Packet, Radio, Transmission
    from tsgt.radio.superframe import SuperframeMaster
    from tsgt.radio.superframe.reception import ReceivedReply

LEAD_NS = 6_000_000
"""A beacon is composed this long before it is due: the radio wants 5 ms of it."""


class Listener(Protocol):
    """Is told what happens in the frames."""

    async def ready(self) -> None:
        """Return when the next frame may be planned: what was heard has been put away, or that takes too long."""
        ...

    def composing(self) -> None:
        """Tell the master what is written: the beacon that is composed now acknowledges it."""
        ...

    def beacon(self, sent: Transmission) -> None:
        """Take note that the beacon of the present frame has gone out."""
        ...

    def heard(self, heard: ReceivedReply, packet: Packet) -> None:
        """Take what a reply brought, and the packet that it came in."""
        ...

    def silent(self, stations: Sequence[int]) -> None:
        """Take note of the stations that had a slot in the frame that has ended, and were not heard."""
        ...


class FrameLoop:
    """Runs frames over a radio, one after the other.

    Parameters
    ----------
    radio
        Started; nobody else receives from it.
    clock
        The radio's.
    master
        Decides.
    listener
        Is told.
    """

    def __init__(self, radio: Radio, clock: Clock, master: SuperframeMaster, listener: Listener) -> None:
        self._radio = radio
        self._clock = clock
        self._master = master
        self._listener = listener

    async def run(self) -> NoReturn:
        """Run frames for as long as the radio does.

        Raises
        ------
        RadioError
            It does no more. Another loop with another radio may go on with the same master.
        """
        while True:
            await self.frame()

    async def frame(self) -> None:
        """Run one frame from its planning to the end of its last slot; raises as :meth:`run`."""
        await self._listener.ready()
        start_ns = self._master.prepare(self._clock.monotonic_ns())
        await self._clock.sleep_until(start_ns - LEAD_NS)
        self._listener.composing()
        sent = await self._radio.transmit(self._master.compose(), at_ns=start_ns)
        self._master.sent(sent.done_at_ns, sent.stamp_sigma_ns)
        self._listener.beacon(sent)
        while (until_ns := self._master.reply_deadline_ns) is not None:
            packet = await next_packet(self._radio, self._clock, until_ns)
            if packet is None:
                break
            heard = self._master.received(packet.payload, packet.received_at_ns, packet.stamp_sigma_ns)
            if heard is not None:
                self._listener.heard(heard, packet)
        self._listener.silent(self._master.finish())
