"""Slot plan of a frame: start and end of each slot, guard times, latest start of a reply.

Times count from the end of the beacon on the air; master and stations compute the same plan from it. A slot lasts as long
as the longest reply of its grant, and a guard time for start jitter and clock drift follows it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.airtime import TX_DONE_NS
from tsgt.radio.superframe.wire import GRANT_BYTES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.radio.base import LoRaSettings
    from tsgt.radio.superframe.wire import SlotOrder

GUARD_UNIT_NS = 250_000  # unit of guard time and turnaround in a beacon

COMPOSE_LEAD_NS = 6_000_000
"""How long before its slot a station composes its reply: the radio needs 3 ms, a Raspberry Pi the rest."""

EXACT_SIGMA_NS = 100_000
"""A timestamp with a larger sigma was made without the edge or without kernel support, and measures no delay."""

OVERLAP_SYMBOLS = 1.2
"""Tolerated overlap with the next preamble: it has twelve symbols, of which a receiver needs six."""

MAX_FRAME_NS = 5_000_000_000

_TIMESTAMP_SYMBOLS = 0.1  # uncertainty of the nominal delay from the end of a packet to RxDone


class Slot(NamedTuple):
    """A station's slot, in ns from the end of the beacon; ``end_ns`` is the end of the longest reply, without guard time."""

    start_ns: int
    end_ns: int
    max_reply_bytes: int


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """Durations of the parts of a frame."""

    settings: LoRaSettings
    guard_ns: int  # after each slot
    turnaround_ns: int  # from the end of the beacon to the first slot

    @classmethod
    def from_tolerances(
        cls, settings: LoRaSettings, *, start_jitter_ns: int, turnaround_ns: int, clock_error_ppm: float
    ) -> FrameTiming:
        """Compute the guard time.

        Parameters
        ----------
        start_jitter_ns
            Maximum delay of the start of a transmission.
        turnaround_ns
            What a station needs between the beacon and the first slot.
        clock_error_ppm
            Maximum rate difference of two clocks.
        """
        drift_ns = MAX_FRAME_NS * clock_error_ppm * 1e-6
        guard_ns = start_jitter_ns + drift_ns + _TIMESTAMP_SYMBOLS * settings.symbol_ns
        return cls(settings, _rounded_up(guard_ns), _rounded_up(turnaround_ns))

    def airtime_ns(self, payload_bytes: int) -> int:
        """Return the airtime of a packet."""
        return self.settings.airtime_ns(payload_bytes)

    @property
    def reception_ns(self) -> int:
        """Nominal delay from the end of a packet on the air to RxDone."""
        return self.settings.rx_done_ns

    @property
    def link_ns(self) -> int:
        """Nominal link delay: from TxDone of the sender to RxDone of the receiver."""
        return self.reception_ns - TX_DONE_NS

    @property
    def tolerance_ns(self) -> int:
        """By how much a late packet may overlap the next preamble without loss."""
        return round(OVERLAP_SYMBOLS * self.settings.symbol_ns)

    def slots(self, grants: Sequence[int], order: SlotOrder) -> list[Slot | None]:
        """Return the slots by station index; None for a station without a slot."""
        slots: list[Slot | None] = [None] * len(grants)
        start_ns = self.turnaround_ns
        for index in slot_sequence(len(grants), order):
            reply_bytes = GRANT_BYTES[grants[index]]
            if reply_bytes:
                end_ns = start_ns + self.airtime_ns(reply_bytes)
                slots[index] = Slot(start_ns, end_ns, reply_bytes)
                start_ns = end_ns + self.guard_ns
        return slots

    def latest_start_ns(self, slot: Slot, reply_bytes: int) -> int:
        """Return the latest start of a reply of this length that leaves the next slot intact."""
        return slot.end_ns + self.guard_ns + self.tolerance_ns - self.airtime_ns(reply_bytes)


def slot_sequence(stations: int, order: SlotOrder) -> list[int]:
    """Return the station indices in the order of their slots."""
    step = -1 if order.reverse else 1
    return [(order.first + step * k) % stations for k in range(stations)]


def _rounded_up(duration_ns: float) -> int:
    """Round up to :data:`GUARD_UNIT_NS`, at most 255 units."""
    return min(math.ceil(duration_ns / GUARD_UNIT_NS), 255) * GUARD_UNIT_NS
