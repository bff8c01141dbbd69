"""A radio without a modem: a test delivers packets, and is notified of sent ones."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tsgt.radio import Packet, Transmission

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.radio import LoRaSettings

AIRTIME_NS = 50_000_000


class PlainRadio:
    """A :class:`~tsgt.radio.base.Radio` whose packets all last 50 ms, and start after ``latency_ns``."""

    def __init__(
        self, clock: Clock, *, rssi_dbm: float = -80.0, snr_db: float = 7.25, latency_ns: int = 0
    ) -> None:
        self._clock = clock
        self._rssi_dbm = rssi_dbm
        self._snr_db = snr_db
        self._latency_ns = latency_ns
        self._packets: asyncio.Queue[Packet] = asyncio.Queue()
        self.on_sent: Callable[[bytes], None] = lambda _: None
        """Called with each payload at the end of its transmission."""

    def deliver(self, payload: bytes) -> None:
        """Deliver a packet now."""
        self._packets.put_nowait(
            Packet(
                payload=payload,
                rssi_dbm=self._rssi_dbm,
                snr_db=self._snr_db,
                received_at_ns=self._clock.monotonic_ns(),
                stamp_sigma_ns=0,
            )
        )

    def deliver_twice(self, payload: bytes) -> None:
        """Deliver a packet and its echo now."""
        self.deliver(payload)
        self.deliver(payload)

    async def configure(self, settings: LoRaSettings) -> None:
        """Accept any settings."""

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
        """Send for 50 ms."""
        await self._clock.sleep_until(at_ns or self._clock.monotonic_ns() + self._latency_ns)
        started_at_ns = self._clock.monotonic_ns()
        await self._clock.sleep_until(started_at_ns + AIRTIME_NS)
        self.on_sent(payload)
        return Transmission(
            started_at_ns=started_at_ns, done_at_ns=self._clock.monotonic_ns(), stamp_sigma_ns=0
        )

    async def receive(self) -> Packet:
        """Return the next packet."""
        return await self._packets.get()

    async def close(self) -> None:
        """Do nothing."""
