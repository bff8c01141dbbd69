"""Beacons and replies of the superframe as dataclasses.

Angles, distances and times are the integers of the air interface, so that nothing is rounded twice;
:func:`~tsgt.radio.superframe.wire.codec.angle_code` and :func:`~tsgt.radio.superframe.wire.codec.distance_code` make them.
docs/reference/radio-protocol.md specifies every bit, with examples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsgt.model import Status

VERSION = 2
"""A change that another version would misread is a new one; peers of different versions do not understand each other."""

MAX_STATIONS = 16

GRANT_BYTES = (0, 5, 17, 21, 26, 30, 35, 39, 44, 53, 62, 71, 80, 89, 107, 125)
"""Maximum reply length by grant, authentication code included; 0: no slot. The steps follow the LoRa code blocks at SF 9."""

ACK_FRAMES = 4  # number of earlier frames that an acknowledgement bitmap covers

TIME_UNIT_US = 16
TIME_BITS = 17
WIDE_TIME_BITS = 36  # in units of 16 us, a narrow time wraps after 2.1 s and a wide time after 12.7 days

MAX_NARROW_AGE_NS = 2_000_000_000
"""Older measurements need a wide block; the age is that at the start of the reply."""

SESSION_TIME_BITS = 40  # the session time in us is transmitted modulo 2^40 us = 12.7 days

SINGLE_QUALITY = 3  # quality of a reply of the form ``single``: bound 128 us

RESTART_SKIP = 20_000
"""Sequence numbers that a restarted station skips: they may have been sent without having reached the journal.
At 20 measurements per second they cover a quarter of an hour without a disk write."""

CONDITION_KIND_BITS, CONDITION_VALUE_BITS = 2, 9

TURNAROUND_BITS = 22  # width of a turnaround in us: at most 4.2 s


def quality_bound_us(quality: int) -> int:
    """Return the timestamp bound of a quality 0 to 15, in us: 16 us, doubled per step."""
    return 16 << quality


@dataclass(frozen=True, slots=True)
class SlotOrder:
    """Order of the slots: cyclic by station number, from station index ``first`` modulo the number of stations."""

    first: int = 0
    reverse: bool = False  # descending numbers


@dataclass(frozen=True, slots=True)
class StationEntry:
    """Acknowledgement and grant of one station in a beacon."""

    ack_bitmap: int  # four bits; bit j: the reply in frame counter - 1 - j is in the master's recording
    grant: int  # index into GRANT_BYTES


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionInfo:
    """What a station needs to authenticate the beacons of a session."""

    nonce: int  # 48 random bits, new for each start of the master
    counter_high: int  # bits 8 to 23 of the frame counter
    sent_high: int  # bits 16 to 39 of the session time of the previous beacon; 0 when ``sent`` is 0
    guard: int  # guard time in units of 0.25 ms, 8 bits
    turnaround: int  # from the end of the beacon to the first slot, in units of 0.25 ms, 8 bits


@dataclass(frozen=True, slots=True)
class JoinConfirmation:
    """Repeats the 32-bit nonce of a station's join request, which proves that the beacon is not a replay."""

    station: int
    nonce: int


@dataclass(frozen=True, slots=True)
class EncodedDirection:
    """Direction in a station's circles, in units of 2 pi / 2^16 (20 arcseconds)."""

    horizontal: int
    zenith: int


@dataclass(frozen=True, slots=True)
class EncodedCommand:
    """A command to a station.

    The argument is the prism less one for code 0, the code of the search half-width (see
    :func:`~tsgt.radio.superframe.wire.codec.spread_rad`) for code 4, and 0 otherwise; ``towards`` is set for code 4 only.
    """

    station: int  # 1 to 16
    command_id: int  # 4 bits, incremented with each command to this station, which executes each one once
    code: int  # 4 bits: 0 track, 1 search, 2 direct, 3 measure, 4 search in a direction
    argument: int = 0  # 4 bits
    towards: EncodedDirection | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Beacon:
    """What the master sends at the start of each frame.

    ``cumulative`` is the cumulative acknowledgement of the station with index ``counter % len(stations)``: the 8 low bits
    of the highest sequence number up to which, inclusive, the master's recording is complete.
    """

    frame: int  # the 8 low bits of the frame counter
    sent: int  # the 16 low bits of the session time in us of the previous beacon's TxDone, sent as 1 if 0; 0: unknown
    cumulative: int
    slot_order: SlotOrder
    stations: tuple[StationEntry, ...]  # 1 to 16, by index: number less one
    session: SessionInfo | None = None
    confirmations: tuple[JoinConfirmation, ...] = ()
    commands: tuple[EncodedCommand, ...] = ()


@dataclass(frozen=True, slots=True)
class EncodedMeasurement:
    """One measurement; angles in units of 2 pi / 2^24."""

    sequence: int  # the low 8 bits, or 32 in a wide block
    time: int  # in units of TIME_UNIT_US, see MeasurementBlock
    status: Status
    horizontal: int
    zenith: int
    distance: int | None  # slope distance, 1 to 2^24 - 1, in units of 0.1 mm, or 1 mm in a far block


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementBlock:
    """Consecutive measurements of one station, newest first.

    Sequence number and time of the newest are known modulo the width of their fields. Decoded numbers and times of the
    older ones are relative to the newest and may be negative.
    """

    measurements: tuple[EncodedMeasurement, ...]  # 1 to 16, descending sequence numbers
    beacon_relative: bool = (
        False  # times count from the end of this frame's beacon; otherwise they are session time
    )
    quality: int = SINGLE_QUALITY  # 0 to 15, see quality_bound_us
    wide: bool = False  # 32-bit sequence numbers and 36-bit times instead of 8 and 17 bits
    prism: int | None = None  # 1 to 16; None: the prism of the station's last status report
    far: bool = False  # distances in units of 1 mm


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinRequest:
    """Identifies a station after a restart of the station or of the master."""

    nonce: int  # 32 random bits, new for each session that the station joins; authenticates all later replies
    stream_id: int  # 16 bits, constant while sequence numbers continue across restarts of the station
    first_sequence: (
        int  # 32 bits: first number of this run of the client; it skipped RESTART_SKIP numbers below
    )
    oldest: int  # 32 bits: lowest number that is not delivered, or the next to be assigned


@dataclass(frozen=True, slots=True)
class ConditionItem:
    """One of the values that describe the condition of an instrument; see :mod:`tsgt.radio.superframe.condition`."""

    kind: int  # 2 bits
    value: int  # 9 bits; 0: unknown, or nothing to say


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReport:
    """Status of a station."""

    prism: int  # the tracked prism, or the last one before direct mode, 1 to 16
    direct: bool  # the instrument is in direct mode
    connected: bool
    missed_slots: int  # slots left empty because the reply was late; the low 8 bits
    rejected_beacons: int  # beacons rejected for an impossible time; the low 4 bits
    rssi_dbm: int  # of the last beacon, -127 to 0
    condition: ConditionItem = ConditionItem(0, 0)


@dataclass(frozen=True, slots=True)
class CommandResponse:
    """Whether a command was executed."""

    command_id: int
    ok: bool


@dataclass(frozen=True, slots=True)
class SingleMeasurement:
    """Result of a measure command; values as in :class:`EncodedMeasurement`, the distance in 0.1 mm."""

    command_id: int
    status: Status
    horizontal: int
    zenith: int
    distance: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What a station sends in its slot.

    ``turnaround_us`` is the time from RxDone of the previous frame's beacon to TxDone of the reply to it, at the master's
    clock rate, in us, 22 bits.
    """

    blocks: tuple[MeasurementBlock, ...] = ()  # newest first
    join_request: JoinRequest | None = None
    status_report: StatusReport | None = None
    turnaround_us: int | None = None
    response: CommandResponse | None = None
    single_measurement: SingleMeasurement | None = None
