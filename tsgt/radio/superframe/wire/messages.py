"""What beacons and replies of the superframe say, and how it is packed into bits.

Angles, distances and times stand here as the whole numbers that go over the air, so that nothing is rounded twice;
:func:`angle_code` and its like make them. docs/reference/radio-protocol.md specifies every bit, with examples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsgt.model import Status

VERSION = 1

MOST_STATIONS = 16

GRANT_BYTES = (0, 5, 17, 21, 26, 30, 35, 39, 44, 53, 62, 71, 80, 89, 107, 125)
"""Longest reply for each grant, code and all; 0 is no slot. Steps of a block at SF 9, then wider ones."""

TIME_UNIT_US = 16
TIME_BITS = 17
WIDE_TIME_BITS = 36
"""In units of 16 us: a narrow time repeats after 2.1 s, a wide one after 12.7 days."""

SESSION_TIME_BITS = 40
"""The master's session time goes over the air in us, modulo this many bits: 12.7 days as well."""

SINGLE_QUALITY = 3
"""A reply of the form ``single`` claims this quality: within 128 us."""

RESTART_SKIP = 20_000
"""A station that starts again leaves out so many numbers: those that were on the air and on no disk. With 20 measurements
a second its disk may have taken none for a quarter of an hour."""

TURN_ROUND_BITS = 22
"""A turn-round goes over the air in us: 4.2 s at most."""


def quality_bound_us(quality: int) -> int:
    """Return what a time of this quality, 0 to 15, is within of the truth, in us: 16 us, and double per step."""
    return 16 << quality


@dataclass(frozen=True, slots=True)
class SlotOrder:
    """In which order the stations answer: by number from ``first`` on, round and round.

    Attributes
    ----------
    first
        Index of the station with the first slot, its number less one; counted modulo the number of stations.
    reverse
        By falling numbers.
    """

    first: int = 0
    reverse: bool = False


@dataclass(frozen=True, slots=True)
class StationEntry:
    """What a beacon says to each station.

    Attributes
    ----------
    history
        Four bits: bit j is set when the reply in the frame j + 1 before this one is in the master's recording.
    grant
        Index into :data:`GRANT_BYTES`.
    """

    history: int
    grant: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionPart:
    """What a station has to know of a master's session before it can check its beacons.

    Attributes
    ----------
    nonce
        Random, 48 bits, new each time that the master starts.
    counter_high
        Bits 8 to 23 of the frame counter.
    sent_high
        Bits 16 to 39 of the session time at which the previous beacon left; 0 with a ``sent`` of 0.
    guard, turn_round
        Between slots, and from the end of a beacon to the first slot, in units of 0.25 ms, 8 bits each.
    """

    nonce: int
    counter_high: int
    sent_high: int
    guard: int
    turn_round: int


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Proof for a station that this master has heard it in this session: the nonce of its introduction, 32 bits."""

    station: int
    nonce: int


@dataclass(frozen=True, slots=True)
class Towards:
    """A direction in a station's circles, in units of 2 pi / 2^16: 20 arcseconds are enough to look for something."""

    horizontal: int
    zenith: int


@dataclass(frozen=True, slots=True)
class OrderPart:
    """An order to a station.

    Attributes
    ----------
    station
        Its number, 1 to 16.
    ticket
        4 bits; another one for each order to this station. It is carried out once.
    order
        4 bits: 0 track, 1 search, 2 direct, 3 measure, 4 search in a direction.
    argument
        4 bits: the prism's number less one for 0; for 4 how wide to search, see
        :func:`~tsgt.radio.superframe.wire.codec.spread_rad`; otherwise 0.
    towards
        Where to search; with 4 alone.
    """

    station: int
    ticket: int
    order: int
    argument: int = 0
    towards: Towards | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Beacon:
    """What the master sends at the beginning of each frame.

    Attributes
    ----------
    frame
        The 8 low bits of the frame counter.
    sent
        The 16 low bits of the session time in us at which the previous beacon left (TxDone); 0: not known. A time
        whose low bits are 0 is sent as 1.
    cumulative
        Of the station with index ``counter % len(stations)``: the low 8 bits of the sequence number up to which, itself
        included, nothing is missing in the master's recording.
    order
        Of the slots.
    stations
        By index: number less one. 1 to 16 of them.
    session, confirmations, orders
        Now and then.
    """

    frame: int
    sent: int
    cumulative: int
    order: SlotOrder
    stations: tuple[StationEntry, ...]
    session: SessionPart | None = None
    confirmations: tuple[Confirmation, ...] = ()
    orders: tuple[OrderPart, ...] = ()


@dataclass(frozen=True, slots=True)
class Sighting:
    """One measurement on the air.

    Attributes
    ----------
    sequence
        Running number; the low 8 bits, or 32 in a wide run.
    time
        In :data:`TIME_UNIT_US`, see :class:`Run`.
    status
        The instrument's verdict.
    horizontal, zenith
        Angles in units of 2 pi / 2^24.
    distance
        Slope distance in units of 0.1 mm, or 1 mm in a far run; 1 to 2^24 - 1. None: the instrument gave none.
    """

    sequence: int
    time: int
    status: Status
    horizontal: int
    zenith: int
    distance: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Measurements of one station that were made one after the other, newest first.

    Sequence number and time of the newest are known modulo the width of their fields. As decoded, those of the older
    ones are relative to it: they may be negative.

    Attributes
    ----------
    sightings
        1 to 16, by falling sequence numbers.
    direct
        Times count from the end of this frame's beacon, by the station's clock alone. Otherwise they are session time.
    quality
        0 to 15, see :func:`quality_bound_us`.
    wide
        Sequence numbers have 32 bits and times 36, instead of 8 and 17.
    prism
        Number of the prism, 1 to 16; None: the one that the station last told in a :class:`StatePart`.
    far
        Distances are in units of 1 mm.
    """

    sightings: tuple[Sighting, ...]
    direct: bool = False
    quality: int = SINGLE_QUALITY
    wide: bool = False
    prism: int | None = None
    far: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Introduction:
    """Who answers, after a start of the station or of the master.

    Attributes
    ----------
    nonce
        Random, 32 bits, new for each session that the station joins; part of the code of all later replies.
    lineage
        16 bits: as long as it stays the same, sequence numbers go on across restarts of the station.
    run_start
        32 bits: number of the first measurement of this run of the client. :data:`RESTART_SKIP` before it are not its own.
    oldest
        32 bits: the lowest number that is still to be delivered, or the next to be given.
    """

    nonce: int
    lineage: int
    run_start: int
    oldest: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StatePart:
    """How the station does.

    Attributes
    ----------
    prism
        Number of the prism that it tracks, or did before direct mode, 1 to 16.
    direct
        It is in direct mode.
    connected
        It has an instrument.
    late
        How many of its slots it had to leave empty because it was late; the low 8 bits.
    doubted
        How many beacons came at a time that cannot be; the low 4 bits.
    rssi_dbm
        Strength of the beacon, -127 to 0.
    """

    prism: int
    direct: bool
    connected: bool
    late: int
    doubted: int
    rssi_dbm: int


@dataclass(frozen=True, slots=True)
class AnswerPart:
    """What became of an order.

    Attributes
    ----------
    ticket
        Of the order.
    ok
        Whether it has been carried out.
    """

    ticket: int
    ok: bool


@dataclass(frozen=True, slots=True)
class ShotPart:
    """A single measurement of a target; fields as in :class:`Sighting`, the distance in 0.1 mm.

    Attributes
    ----------
    ticket
        Of the order.
    """

    ticket: int
    status: Status
    horizontal: int
    zenith: int
    distance: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What a station sends in its slot.

    Attributes
    ----------
    runs
        Measurements, newest first.
    introduction, state, answer, shot
        Now and then.
    turn_round_us
        From RxDone of the beacon before this one to TxDone of the reply to it, put on the master's rate, in us, 22 bits;
        None: not told.
    """

    runs: tuple[Run, ...] = ()
    introduction: Introduction | None = None
    state: StatePart | None = None
    turn_round_us: int | None = None
    answer: AnswerPart | None = None
    shot: ShotPart | None = None
