"""Observes daemons of a simulated mission at their hardware.

Of a station's client the readings from its instrument; of a master with protocol classic the measurements with which
stations replied to its polls.
"""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.classic import MEASUREMENT_BYTES, decode_command
from tsgt.station.leica import LeicaInstrument

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    from tsgt.clock import Clock
    from tsgt.config import LeicaInstrumentConfig
    from tsgt.radio import LoRaSettings, Packet, Radio, RadioOpener, Transmission
    from tsgt.station import Reading
    from tsgt.station.serial import OpenPort


class ObservedInstrument(LeicaInstrument):
    """A Leica instrument that passes each reading of the tracked prism to a callback as well."""

    def __init__(
        self,
        config: LeicaInstrumentConfig,
        open_port: OpenPort,
        clock: Clock,
        on_reading: Callable[[Reading], None],
    ) -> None:
        super().__init__(config, open_port, clock)
        self._on_reading = on_reading

    async def read(self) -> Reading:
        """Return the next measurement."""
        reading = await super().read()
        self._on_reading(reading)
        return reading


class PollReply(NamedTuple):
    """The first packet of a measurement's length after a poll."""

    station: int  # that was polled
    payload: bytes
    received_at_ns: int  # on the clock of the master's radio; in a log, true time from the start


class ObservedRadio:
    """A :class:`~tsgt.radio.Radio` that passes each reply to a poll to a callback as well."""

    def __init__(self, radio: Radio, on_reply: Callable[[PollReply], None]) -> None:
        self._radio = radio
        self._on_reply = on_reply
        self._polled: int | None = None
        self._polled_at_ns = 0

    async def configure(self, settings: LoRaSettings) -> None:
        """Change the settings."""
        await self._radio.configure(settings)

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
        """Send a packet."""
        self._polled = None
        sent = await self._radio.transmit(payload, at_ns=at_ns)
        command = decode_command(payload)
        if command is not None and command.letter == "t":
            self._polled, self._polled_at_ns = command.station, sent.done_at_ns
        return sent

    async def receive(self) -> Packet:
        """Return the next packet."""
        packet = await self._radio.receive()
        if (
            self._polled is not None
            and len(packet.payload) == MEASUREMENT_BYTES
            and packet.payload[0] == self._polled
            and packet.received_at_ns > self._polled_at_ns
        ):
            self._on_reply(PollReply(self._polled, packet.payload, packet.received_at_ns))
            self._polled = None
        return packet

    async def close(self) -> None:
        """Release the hardware."""
        await self._radio.close()


def observed_radio(open_radio: RadioOpener, on_reply: Callable[[PollReply], None]) -> RadioOpener:
    """Return an opener whose radios pass the replies to polls to a callback."""

    @asynccontextmanager
    async def opened() -> AsyncGenerator[Radio]:
        async with open_radio() as radio:
            yield ObservedRadio(radio, on_reply)

    return opened
