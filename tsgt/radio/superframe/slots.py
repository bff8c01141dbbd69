"""The time plan of a superframe: when the beacon ends, whose slot is when, how late is too late.

Everything counts from the end of the beacon on the air. Master and stations compute the same plan from the same
beacon, so that nobody has to be told when its slot is.

A slot lasts as long as the longest reply that it is granted for, and is followed by a guard time. The guard is what the
two computers on either side of it can be wrong by, as their configuration states: how late one of them starts a
transmission, and how far their clocks run apart within a frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.airtime import TX_DONE_NS, airtime_us, rx_done_ns, symbol_time_ns
from tsgt.radio.superframe.wire import GRANT_BYTES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.radio.base import LoRaSettings
    from tsgt.radio.superframe.wire import SlotOrder

GUARD_UNIT_NS = 250_000
"""Guard and turn-round are told to the stations in these units."""

OVERLAP_SYMBOLS = 1.2
"""A packet may end this far into the next one's preamble: twelve symbols, of which a receiver needs six."""

LONGEST_FRAME_NS = 5_000_000_000

_STAMP_SYMBOLS = 0.1
"""When a radio reports the end of a packet is known beforehand to this."""


class SlotSpan(NamedTuple):
    """A station's slot, in ns from the end of the beacon on the air.

    Attributes
    ----------
    start_ns
        When its reply begins.
    end_ns
        When the longest reply that it is granted ends; the guard comes after that.
    reply_bytes
        The longest reply.
    """

    start_ns: int
    end_ns: int
    reply_bytes: int


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """How long the parts of a frame last.

    Attributes
    ----------
    settings
        Of the modem.
    guard_ns
        Between two slots, and after the last.
    turn_round_ns
        From the end of the beacon to the first slot.
    """

    settings: LoRaSettings
    guard_ns: int
    turn_round_ns: int

    @classmethod
    def stated(
        cls, settings: LoRaSettings, *, start_jitter_ns: int, turn_round_ns: int, clock_error_ppm: float
    ) -> FrameTiming:
        """Compute the guard from what is stated of computers and clocks.

        Parameters
        ----------
        settings
            Of the modem.
        start_jitter_ns
            How late a transmission starts at worst.
        turn_round_ns
            What a station needs between the beacon and the first slot.
        clock_error_ppm
            By how much two clocks run apart.
        """
        symbol_ns = symbol_time_ns(settings.spreading_factor, settings.bandwidth_hz)
        drift_ns = LONGEST_FRAME_NS * clock_error_ppm * 1e-6
        guard_ns = start_jitter_ns + drift_ns + _STAMP_SYMBOLS * symbol_ns
        return cls(settings, in_units(guard_ns) * GUARD_UNIT_NS, in_units(turn_round_ns) * GUARD_UNIT_NS)

    def airtime_ns(self, payload_bytes: int) -> int:
        """Return how long a packet is on the air."""
        settings = self.settings
        return 1000 * airtime_us(
            payload_bytes,
            spreading_factor=settings.spreading_factor,
            bandwidth_hz=settings.bandwidth_hz,
            coding_rate=settings.coding_rate,
            preamble_symbols=settings.preamble_symbols,
            crc=settings.crc,
            low_data_rate=settings.low_data_rate,
        )

    @property
    def reception_ns(self) -> int:
        """From the end of a packet on the air to RxDone, as known beforehand."""
        return rx_done_ns(self.settings.spreading_factor, self.settings.bandwidth_hz)

    @property
    def link_ns(self) -> int:
        """From TxDone of a sender to RxDone of its receiver, as known beforehand; the true one is measured."""
        return self.reception_ns - TX_DONE_NS

    @property
    def tolerance_ns(self) -> int:
        """How far into the next packet's preamble a late one may reach without harm, in ns."""
        symbol_ns = symbol_time_ns(self.settings.spreading_factor, self.settings.bandwidth_hz)
        return round(OVERLAP_SYMBOLS * symbol_ns)

    def slots(self, grants: Sequence[int], order: SlotOrder) -> list[SlotSpan | None]:
        """Return the slot of each station, by index; None for those without one.

        Parameters
        ----------
        grants
            By station index, as in the beacon.
        order
            As in the beacon.
        """
        spans: list[SlotSpan | None] = [None] * len(grants)
        start_ns = self.turn_round_ns
        for index in slot_sequence(len(grants), order):
            reply_bytes = GRANT_BYTES[grants[index]]
            if reply_bytes:
                end_ns = start_ns + self.airtime_ns(reply_bytes)
                spans[index] = SlotSpan(start_ns, end_ns, reply_bytes)
                start_ns = end_ns + self.guard_ns
        return spans

    def latest_start_ns(self, slot: SlotSpan, reply_bytes: int) -> int:
        """Return until when a reply of this length may begin without harming the next slot, from the beacon's end."""
        return slot.end_ns + self.guard_ns + self.tolerance_ns - self.airtime_ns(reply_bytes)


def slot_sequence(stations: int, order: SlotOrder) -> list[int]:
    """Return the indices of the stations in the order of their slots."""
    step = -1 if order.reverse else 1
    return [(order.first + step * k) % stations for k in range(stations)]


def in_units(duration_ns: float) -> int:
    """Return guard or turn-round as it goes over the air: in :data:`GUARD_UNIT_NS`, rounded up, 8 bits at most."""
    return min(math.ceil(duration_ns / GUARD_UNIT_NS), 255)
