"""The interface of a LoRa radio and its records."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Protocol

from tsgt.errors import RadioSettingsError
from tsgt.radio.airtime import airtime_us, rx_done_ns, symbol_time_ns

BANDWIDTHS_HZ = (7_800, 10_400, 15_600, 20_800, 31_250, 41_700, 62_500, 125_000, 250_000, 500_000)
"""Nominal bandwidths of the SX127x, in the order of their register codes."""

MAX_PAYLOAD_BYTES = 255  # the length is one byte of the LoRa header

_LIMITS = {
    "frequency_hz": (137_000_000, 1_020_000_000),
    "spreading_factor": (7, 12),  # SF 6 has no explicit header, which tsgt always uses
    "coding_rate": (5, 8),
    "preamble_symbols": (6, 65_535),
    "sync_word": (0x00, 0xFF),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LoRaSettings:
    """Settings of the modem; two radios receive each other only if all but power and coding rate agree.

    Raises RadioSettingsError if a value is out of its range.

    Attributes
    ----------
    frequency_hz
        137 MHz to 1020 MHz; board and regulations allow far less.
    spreading_factor, bandwidth_hz
        7 to 12; one of :data:`BANDWIDTHS_HZ`.
    coding_rate
        Denominator of the rate: 5 to 8 for 4/5 to 4/8.
    preamble_symbols
        Programmed number, 6 to 65535; 4.25 more are sent.
    sync_word
        0x34 is that of public LoRaWAN and of the authors' nodes.
    crc
        Send a payload CRC and drop packets without one.
    inverted_iq
        Send and receive inverted chirps, which other radios cannot receive.
    low_data_rate
        Low data rate optimisation. None: on for symbols above 16 ms, as the data sheet requires.
    power_dbm
        At the PA_BOOST pin: 2 to 17, or 20 where the driver allows it.
    """

    frequency_hz: int
    spreading_factor: int
    bandwidth_hz: int
    coding_rate: int
    preamble_symbols: int = 8
    sync_word: int = 0x34
    crc: bool = True
    inverted_iq: bool = False
    low_data_rate: bool | None = None
    power_dbm: int = 14

    def __post_init__(self) -> None:
        for name, (lowest, highest) in _LIMITS.items():
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise RadioSettingsError(f"{name} must be {lowest} to {highest}, got {value}")
        if self.bandwidth_hz not in BANDWIDTHS_HZ:
            known = ", ".join(map(str, BANDWIDTHS_HZ))
            raise RadioSettingsError(f"bandwidth_hz must be one of {known}, got {self.bandwidth_hz}")
        if not 2 <= self.power_dbm <= 17 and self.power_dbm != 20:
            raise RadioSettingsError(f"power_dbm must be 2 to 17, or 20, got {self.power_dbm}")

    @property
    def symbol_ns(self) -> int:
        """Duration of a symbol."""
        return symbol_time_ns(self.spreading_factor, self.bandwidth_hz)

    @property
    def rx_done_ns(self) -> int:
        """Nominal delay from the end of a packet on the air to RxDone of its receiver."""
        return rx_done_ns(self.spreading_factor, self.bandwidth_hz)

    def airtime_ns(self, payload_bytes: int) -> int:
        """Return the airtime of a packet, in whole microseconds."""
        return 1000 * airtime_us(
            payload_bytes,
            spreading_factor=self.spreading_factor,
            bandwidth_hz=self.bandwidth_hz,
            coding_rate=self.coding_rate,
            preamble_symbols=self.preamble_symbols,
            crc=self.crc,
            low_data_rate=self.low_data_rate,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Packet:
    """A received packet.

    Attributes
    ----------
    snr_db
        Saturates near 10 dB.
    received_at_ns
        CLOCK_MONOTONIC when the radio reported the end of the packet. An SX127x does so 0.65 to 0.95 symbols
        after the end on the air, the same for each packet of one spreading factor and bandwidth.
    stamp_sigma_ns
        One sigma of ``received_at_ns``; large where the edge of the interrupt line was lost and polling found the packet.
    """

    payload: bytes
    rssi_dbm: float
    snr_db: float
    received_at_ns: int
    stamp_sigma_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Transmission:
    """A sent packet.

    Attributes
    ----------
    started_at_ns
        CLOCK_MONOTONIC just before the command to send: the requested instant, or later.
    done_at_ns
        CLOCK_MONOTONIC of the reported end; an SX127x reports 67 microseconds after the end on the air.
    stamp_sigma_ns
        One sigma of ``done_at_ns``.
    """

    started_at_ns: int
    done_at_ns: int
    stamp_sigma_ns: int


class Radio(Protocol):
    """A half-duplex LoRa radio; it receives whenever it does not send."""

    async def configure(self, settings: LoRaSettings) -> None:
        """Change the settings; raises RadioError if the radio does not accept them, and retries in the background."""
        ...

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
        """Send one packet and return after its end; the radio then receives again.

        Calls from several tasks are queued. Cancelling a call aborts its packet. ``payload``: 1 to 255 bytes.
        ``at_ns``: CLOCK_MONOTONIC of the start; None or a past instant: now. Raises RadioTimeoutError if the end was
        not reported in time; the packet may have been received. Raises RadioError if the packet was not sent.
        """
        ...

    async def receive(self) -> Packet:
        """Return the oldest queued packet, or wait for the next one."""
        ...

    async def close(self) -> None:
        """Stop and release the hardware; tasks that wait in :meth:`receive` are not woken."""
        ...


RadioOpener = Callable[[], AbstractAsyncContextManager[Radio]]
"""Makes a context with a radio that is set up and receives; entering raises :class:`RadioError`, or :class:`StreamError`
for a simulated radio without its air server."""
