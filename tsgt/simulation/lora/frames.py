"""What the radios and the air between them say to each other: frames, listening, receptions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from tsgt.radio import HEADER_SYMBOLS, payload_symbols, symbol_time_ns


@dataclass(frozen=True)
class Modulation:
    """What sender and receiver must have in common to hear each other (facts/radio.md 3.3).

    Attributes
    ----------
    frequency_hz
        Carrier as the radio believes to have set it.
    spreading_factor
        6 to 12.
    bandwidth_hz
        Occupied bandwidth.
    inverted_iq
        Whether up-chirps and down-chirps change places.
    sync_word
        One byte, mapped to two symbols at the end of the preamble.
    explicit_header
        Whether the frame says itself how long it is and how it is coded.
    low_data_rate
        Whether low-data-rate optimisation is on.
    """

    frequency_hz: float
    spreading_factor: int
    bandwidth_hz: float
    inverted_iq: bool
    sync_word: int
    explicit_header: bool
    low_data_rate: bool


@dataclass(frozen=True)
class Frame:
    """One packet on the air, from the first symbol of its preamble on.

    Attributes
    ----------
    modulation
        How it is sent.
    coding_rate
        Denominator of the code of its payload, 5 to 8 for 4/5 to 4/8.
    crc
        Whether the payload has a checksum.
    preamble_symbols
        As programmed; 4.25 symbols more are on the air.
    payload
        Its bytes, 1 to 255.
    power_dbm
        At the sender's antenna connector.
    start_ns
        When it starts, on the air's timeline.
    """

    modulation: Modulation
    coding_rate: int
    crc: bool
    preamble_symbols: int
    payload: bytes
    power_dbm: float
    start_ns: int

    @cached_property
    def symbol_ns(self) -> int:
        """Duration of one symbol."""
        return symbol_time_ns(self.modulation.spreading_factor, int(self.modulation.bandwidth_hz))

    @cached_property
    def programmed_preamble_end_ns(self) -> int:
        """When the last preamble symbol ends that the receiver may use to find it; the sync word follows."""
        return self.start_ns + self.preamble_symbols * self.symbol_ns

    @cached_property
    def preamble_end_ns(self) -> int:
        """When the preamble with its sync word has ended: 4.25 symbols after the programmed ones."""
        return self.start_ns + (4 * self.preamble_symbols + 17) * self.symbol_ns // 4

    @cached_property
    def header_end_ns(self) -> int:
        """When the first eight symbols after the preamble have ended, which hold an explicit header."""
        return self.preamble_end_ns + HEADER_SYMBOLS * self.symbol_ns

    @cached_property
    def header(self) -> Header:
        """What an explicit header says of it."""
        return Header(len(self.payload), self.coding_rate, self.crc)

    @cached_property
    def end_ns(self) -> int:
        """When its last symbol ends, if nobody cuts it short."""
        return self.end_as_read_ns(self.header, low_data_rate=self.modulation.low_data_rate)

    def end_as_read_ns(self, header: Header, *, low_data_rate: bool) -> int:
        """When a receiver believes that it ends, which knows no more of it than this."""
        symbols = payload_symbols(
            header.payload_bytes,
            spreading_factor=self.modulation.spreading_factor,
            coding_rate=header.coding_rate,
            explicit_header=self.modulation.explicit_header,
            crc=header.crc,
            low_data_rate=low_data_rate,
        )
        return self.preamble_end_ns + symbols * self.symbol_ns


@dataclass(frozen=True, slots=True)
class Listening:
    """What a receiver is set to hear.

    Attributes
    ----------
    modulation
        What it demodulates.
    since_ns
        When it began to listen.
    preamble_symbols
        As programmed; a sender's longer preamble is not recognised.
    max_payload_bytes
        A header that announces more is dropped.
    payload_bytes, coding_rate, crc
        What it takes for granted where there is no header to tell.
    """

    modulation: Modulation
    since_ns: int
    preamble_symbols: int
    max_payload_bytes: int
    payload_bytes: int
    coding_rate: int
    crc: bool


@dataclass(frozen=True, slots=True)
class Header:
    """What a frame says of itself: payload length, denominator of its coding rate, checksum or not."""

    payload_bytes: int
    coding_rate: int
    crc: bool


@dataclass(frozen=True, slots=True)
class Reception:
    """A frame whose end a receiver has reached.

    Attributes
    ----------
    payload
        The bytes as the receiver has them, damaged where they are.
    crc_ok
        Whether checksum and payload agree; always true of a frame without checksum.
    header
        As received, or as taken for granted.
    snr_db, rssi_dbm
        Signal to noise ratio and power of the frame itself at the receiver.
    frequency_error_hz
        Positive: the sender's carrier lies above the receiver's.
    """

    payload: bytes
    crc_ok: bool
    header: Header
    snr_db: float
    rssi_dbm: float
    frequency_error_hz: float


class Antenna(Protocol):
    """What the air tells a radio, each at the time when it happens."""

    def preamble_detected(self, at_ns: int) -> None:
        """Lock: a preamble was found."""
        ...

    def header_received(self, at_ns: int, header: Header) -> None:
        """Take an explicit header that arrived with its checksum right."""
        ...

    def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
        """End of the frame that it was locked to, on the air; None: the lock was lost, nothing to report."""
        ...


class Port(Protocol):
    """What a radio does to the air."""

    def transmit(self, frame: Frame) -> None:
        """Put a frame on the air."""
        ...

    def stop_transmitting(self, at_ns: int) -> None:
        """Cut the frame that is on the air; nothing happens when there is none."""
        ...

    def listen(self, listening: Listening | None) -> None:
        """Listen from now on, anew, or become deaf (None); the frame it was locked to is lost silently."""
        ...

    def rssi_dbm(self, at_ns: int) -> float:
        """Power on the channel now, the receiver's noise included."""
        ...

    def preamble_present(self, modulation: Modulation, at_ns: int) -> bool:
        """Whether a channel activity detection finds a preamble in the symbol that ends at this moment."""
        ...
