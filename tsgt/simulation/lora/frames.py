"""Interface between radios and channel: frames, receiver settings, receptions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from tsgt.radio import HEADER_SYMBOLS, payload_symbols, symbol_time_ns


@dataclass(frozen=True)
class Modulation:
    """What sender and receiver must share."""

    frequency_hz: float  # nominal carrier frequency
    spreading_factor: int  # 6 to 12
    bandwidth_hz: float
    inverted_iq: bool  # whether up-chirps and down-chirps are swapped
    sync_word: int  # one byte, in two symbols at the end of the preamble
    explicit_header: bool  # whether the frame carries its length and coding
    low_data_rate: bool  # low-data-rate optimisation


@dataclass(frozen=True)
class Frame:
    """A packet on the air, from the first symbol of its preamble."""

    modulation: Modulation
    coding_rate: int  # denominator of the payload's code rate, 5 to 8 for 4/5 to 4/8
    crc: bool
    preamble_symbols: int  # as programmed; 4.25 symbols more are on the air
    payload: bytes  # 1 to 255 bytes
    power_dbm: float  # at the sender's antenna connector
    start_ns: int  # start, on the channel's timeline

    @cached_property
    def symbol_ns(self) -> int:
        """Symbol duration."""
        return symbol_time_ns(self.modulation.spreading_factor, int(self.modulation.bandwidth_hz))

    @cached_property
    def programmed_preamble_end_ns(self) -> int:
        """End of the programmed preamble, which the receiver may use for detection; the sync word follows."""
        return self.start_ns + self.preamble_symbols * self.symbol_ns

    @cached_property
    def preamble_end_ns(self) -> int:
        """End of preamble and sync word: 4.25 symbols after the programmed preamble."""
        return self.start_ns + (4 * self.preamble_symbols + 17) * self.symbol_ns // 4

    @cached_property
    def header_end_ns(self) -> int:
        """End of the first eight symbols after the preamble, which hold an explicit header."""
        return self.preamble_end_ns + HEADER_SYMBOLS * self.symbol_ns

    @cached_property
    def header(self) -> Header:
        """Content of an explicit header."""
        return Header(len(self.payload), self.coding_rate, self.crc)

    @cached_property
    def end_ns(self) -> int:
        """Nominal end of the last symbol."""
        return self.end_by_header_ns(self.header, low_data_rate=self.modulation.low_data_rate)

    def end_by_header_ns(self, header: Header, *, low_data_rate: bool) -> int:
        """Return the end that a receiver expects from this header."""
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
class ReceiverSettings:
    """Settings of a listening receiver.

    Attributes
    ----------
    payload_bytes, coding_rate, crc
        Assumed for frames without a header.
    """

    modulation: Modulation
    since_ns: int  # when it started to listen
    preamble_symbols: int  # as programmed; a longer preamble is not recognised
    max_payload_bytes: int  # frames whose header announces more are dropped
    payload_bytes: int
    coding_rate: int
    crc: bool


@dataclass(frozen=True, slots=True)
class Header:
    """Payload length, code rate denominator, and presence of a checksum."""

    payload_bytes: int
    coding_rate: int
    crc: bool


@dataclass(frozen=True, slots=True)
class Reception:
    """A frame that a receiver has received to its end.

    Attributes
    ----------
    snr_db, rssi_dbm
        Of the frame itself at the receiver.
    """

    payload: bytes  # as received, possibly damaged
    crc_ok: bool  # whether the checksum matches; True for a frame without one
    header: Header  # as received, or as assumed
    snr_db: float
    rssi_dbm: float
    frequency_error_hz: float  # positive: the sender's carrier is above the receiver's


class FrameListener(Protocol):
    """Callbacks from the channel to a radio, each at the time of the event."""

    def preamble_detected(self, at_ns: int) -> None:
        """Handle the detection of a preamble; the receiver is locked."""
        ...

    def header_received(self, at_ns: int, header: Header) -> None:
        """Handle an explicit header that arrived intact."""
        ...

    def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
        """Handle the end of the frame; None: it was lost."""
        ...


class AirPort(Protocol):
    """A radio's interface to the channel."""

    def transmit(self, frame: Frame) -> None:
        """Transmit a frame."""
        ...

    def stop_transmitting(self, at_ns: int) -> None:
        """Cut the frame on the air; no effect if there is none."""
        ...

    def listen(self, listening: ReceiverSettings | None) -> None:
        """Restart the receiver with these settings, or stop it (None); the frame it is locked to is lost without callback."""
        ...

    def rssi_dbm(self, at_ns: int) -> float:
        """Return the current power on the channel, receiver noise included."""
        ...

    def preamble_present(self, modulation: Modulation, at_ns: int) -> bool:
        """Whether channel activity detection finds a preamble in the symbol that ends now."""
        ...
