"""What the program asks of a LoRa radio, and the records that pass between them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Protocol

from tsgt.errors import RadioSettingsError

BANDWIDTHS_HZ = (7_800, 10_400, 15_600, 20_800, 31_250, 41_700, 62_500, 125_000, 250_000, 500_000)
"""Nominal bandwidths of the SX127x, in the order of their register codes."""

MAX_PAYLOAD_BYTES = 255
"""Longest payload: the length is one byte of the LoRa header."""

_LIMITS = {
    "frequency_hz": (137_000_000, 1_020_000_000),
    "spreading_factor": (7, 12),  # SF 6 has no explicit header, which tsgt always uses
    "coding_rate": (5, 8),
    "preamble_symbols": (6, 65_535),
    "sync_word": (0x00, 0xFF),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LoRaSettings:
    """Settings of the modem; two radios hear each other only if all but power and coding rate agree.

    Attributes
    ----------
    frequency_hz
        Carrier, 137 MHz to 1020 MHz; the board and the law leave far less.
    spreading_factor
        7 to 12.
    bandwidth_hz
        One of :data:`BANDWIDTHS_HZ`.
    coding_rate
        Denominator of the rate: 5 to 8 stand for 4/5 to 4/8.
    preamble_symbols
        As programmed, 6 to 65535; 4.25 more are on the air.
    sync_word
        One byte; 0x34 is that of public LoRaWAN and of the authors' nodes.
    crc
        Send a payload CRC and receive nothing without one.
    inverted_iq
        Send and receive with inverted chirps, unheard by all radios that do not.
    low_data_rate
        Low data rate optimisation. None: as the data sheet demands, on for symbols above 16 ms.
    power_dbm
        At the PA_BOOST pin: 2 to 17, or 20 where the driver allows it.

    Raises
    ------
    RadioSettingsError
        A value is out of its range.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Packet:
    """A packet that arrived.

    Attributes
    ----------
    payload
        As sent.
    rssi_dbm, snr_db
        Strength of the signal, and its ratio to the noise; the SNR of a chip saturates near 10 dB.
    received_at_ns
        CLOCK_MONOTONIC when the radio reported the end of the packet. An SX127x does so 0.65 to 0.95 symbols
        after the end on the air, the same for each packet of one spreading factor and bandwidth.
    stamp_sigma_ns
        One sigma of ``received_at_ns``. Small where the interrupt line was stamped; large where its edge was lost
        and the packet was found by polling.
    """

    payload: bytes
    rssi_dbm: float
    snr_db: float
    received_at_ns: int
    stamp_sigma_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Transmitted:
    """A packet that was sent.

    Attributes
    ----------
    started_at_ns
        CLOCK_MONOTONIC just before the radio was told to send: the instant asked for, or later.
    done_at_ns
        CLOCK_MONOTONIC when it reported the end; an SX127x does so 67 microseconds after the end on the air.
    stamp_sigma_ns
        One sigma of ``done_at_ns``.
    """

    started_at_ns: int
    done_at_ns: int
    stamp_sigma_ns: int


class Radio(Protocol):
    """A half-duplex LoRa radio that receives whenever it does not send."""

    async def configure(self, settings: LoRaSettings) -> None:
        """Change the settings of a running radio.

        Raises
        ------
        RadioError
            The radio does not take them; it goes on trying in the background.
        """
        ...

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmitted:
        """Send one packet and return when it is out; the radio then receives again.

        Calls from several tasks queue up. A call that is cancelled takes its packet off the air.

        Parameters
        ----------
        payload
            1 to 255 bytes.
        at_ns
            CLOCK_MONOTONIC of the start; None or an instant that has passed: now.

        Raises
        ------
        RadioTimeoutError
            The end was not reported in time; nobody knows whether the packet was heard.
        RadioError
            The packet was not sent.
        """
        ...

    async def receive(self) -> Packet:
        """Return the oldest packet that waits, or the next one to arrive."""
        ...

    async def close(self) -> None:
        """Fall silent and let go of the hardware; tasks that wait in :meth:`receive` are not woken."""
        ...


OpenRadio = Callable[[], AbstractAsyncContextManager[Radio]]
"""Makes a context that holds a radio which is set up and receives; entering raises :class:`RadioError`, or
:class:`StreamError` for a simulated radio without its air."""
