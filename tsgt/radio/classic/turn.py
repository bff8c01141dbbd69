"""What the master's side of the paper's protocol is made of: turns, their requests, and how long they take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from tsgt.radio.airtime import TX_DONE_NS, airtime_us, rx_done_ns, symbol_time_ns

if TYPE_CHECKING:
    from tsgt.radio.base import LoRaSettings

TURNAROUND_NS = 100_000_000
"""What a station may at least take from a request to its reply; the authors' nodes take 12 ms."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How long everything takes on the air.

    Attributes
    ----------
    settings
        Of the modem.
    reply_timeout_ns
        From the end of a request to RxDone of its reply, as configured.
    tx_done_ns, rx_done_ns
        From the end of a packet to TxDone of its sender and to RxDone of its receiver.
    """

    settings: LoRaSettings
    reply_timeout_ns: int
    tx_done_ns: int
    rx_done_ns: int

    @classmethod
    def of(cls, settings: LoRaSettings, reply_timeout_ns: int) -> Timing:
        """Return the timing that belongs to the settings of a modem."""
        lag_ns = rx_done_ns(settings.spreading_factor, settings.bandwidth_hz)
        return cls(settings, reply_timeout_ns, TX_DONE_NS, lag_ns)

    @property
    def symbol_ns(self) -> int:
        """Duration of a symbol."""
        return symbol_time_ns(self.settings.spreading_factor, self.settings.bandwidth_hz)

    def airtime_ns(self, payload_bytes: int) -> int:
        """Return how long a packet is on the air."""
        return 1000 * airtime_us(
            payload_bytes,
            spreading_factor=self.settings.spreading_factor,
            bandwidth_hz=self.settings.bandwidth_hz,
            coding_rate=self.settings.coding_rate,
            preamble_symbols=self.settings.preamble_symbols,
            crc=self.settings.crc,
            low_data_rate=self.settings.low_data_rate,
        )

    def timeout_ns(self, reply_bytes: int) -> int:
        """Return how long to wait for a reply: as configured, or longer where the air is slow (SF 10 and above)."""
        return max(self.reply_timeout_ns, self.airtime_ns(reply_bytes) + self.rx_done_ns + TURNAROUND_NS)


@dataclass(frozen=True, slots=True)
class Request:
    """A packet that a turn wants to have sent.

    Attributes
    ----------
    payload
        What to send.
    reply_timeout_ns
        From the end of the transmission to RxDone of the reply; 0: there is no reply.
    """

    payload: bytes
    reply_timeout_ns: int


class Turn(Protocol):
    """Something that the master does with one station, while all others are silent.

    After :meth:`request` the packet is sent. If it expects a reply, packets are handed to :meth:`replied` until one
    is accepted, or the time has passed (:meth:`timed_out`). Then comes the next :meth:`request`.
    """

    station: int

    def request(self) -> Request | None:
        """Return what to send next; None: the turn is over."""
        ...

    def replied(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:
        """Take a packet that came after the request.

        Parameters
        ----------
        payload
            Whatever the radio has heard.
        sent_ns, received_ns
            When the request began on the air, and RxDone of this packet, on the master's Unix clock in ns.
        exact
            Both come from edges of the radio's interrupt line, and are no guesses.

        Returns
        -------
        bool
            Whether this was the reply. If not, the wait goes on.
        """
        ...

    def timed_out(self) -> None:
        """Learn that no reply came."""
        ...
