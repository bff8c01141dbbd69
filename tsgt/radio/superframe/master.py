"""The master's side of the superframe: sends beacons, receives replies. Sans-I/O: time and random bits are passed in.

A frame: :meth:`SuperframeMaster.prepare` plans it, :meth:`~SuperframeMaster.compose` returns the beacon as late as possible
to acknowledge what is recorded, then ``sent`` takes TxDone, ``received`` the replies, and ``finish`` returns the silent
stations. It may be aborted at any step: the next one starts with ``prepare``, and no acknowledgement is revoked. A reply's
station is the one whose authentication code matches: the code covers session, frame, beacon and station.
"""

from __future__ import annotations

import hmac
import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from tsgt.errors import MessageError
from tsgt.radio.airtime import TX_DONE_NS
from tsgt.radio.superframe.demand import DEFAULT_GRANT, DemandEstimator, max_grant, retry_stations
from tsgt.radio.superframe.reception import ReplyTiming
from tsgt.radio.superframe.session import full_counter
from tsgt.radio.superframe.slots import EXACT_SIGMA_NS, GUARD_UNIT_NS, slot_sequence
from tsgt.radio.superframe.station_state import StationState
from tsgt.radio.superframe.timing import StationTiming
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    GRANT_BYTES,
    SESSION_TIME_BITS,
    Beacon,
    SessionInfo,
    SlotOrder,
    StationEntry,
    decode_beacon,
    decode_reply,
    encode_beacon,
)
from tsgt.timesync import LinkDelayEstimator

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from tsgt.radio.superframe.phase_lock import PhaseLock
    from tsgt.radio.superframe.reception import ReceivedReply
    from tsgt.radio.superframe.slots import FrameTiming, Slot
    from tsgt.radio.superframe.wire import Authenticator, Reply

NONCE_BITS = 48

MAX_FRAMES_PER_SESSION = (1 << 24) - 1  # the frame counter has 24 bits; a new session starts before it wraps

SESSION_INTERVAL = 32
SESSION_INTERVAL_JOINING = 4
SESSION_STARTUP_FRAMES = 12
"""Beacons with a session item, which a station needs to join: one in 32, one in 4 while a station is missing, and all of
the first 12."""

EXCHANGES_PER_FRAME = 3  # with more stations their initial two-way exchanges are spread over several frames

REJOIN_FRAMES = 4  # a station that was silent for more frames may have to join again

ABSENT_FRAMES = 20  # a station that was silent for more frames has a slot only in frames with a session item

IDLE_FRAME_NS = 400_000_000  # length of a frame without slots


@dataclass(slots=True)
class _Frame:
    """A frame; instants on the master's CLOCK_MONOTONIC."""

    counter: int
    start_ns: int  # planned start of the beacon
    grants: tuple[int, ...]
    slot_order: SlotOrder
    draft: Beacon  # without station entries, slot order and cumulative acknowledgement
    code: bytes = b""  # authentication code of the beacon
    sent_ns: int | None = None  # TxDone of the beacon
    sent_sigma_ns: int = 0
    slots: list[Slot | None] = field(default_factory=list)  # by station index
    pending: dict[int, StationState] = field(default_factory=dict)  # no reply yet; by station index


class SuperframeMaster:
    """Runs the frames of a session, and a new session when the frame counter is exhausted.

    ``session``, ``counter``: session nonce, and frame counter in the session; -1 before the first frame.
    ``rejected_packets``: packets that were not a reply to the present beacon: of others, forged, late, repeated.
    ``other_beacons``: of these, authentic beacons of another session: another master with this key, or recorded ones.

    Parameters
    ----------
    prisms
        Default prism by station number, 1 to 16.
    now_ns
        On the master's CLOCK_MONOTONIC, as all instants here; zero of the session time.
    phase_lock
        Plans the start of frames; None: as early as possible.
    records
        Measurements are recorded. Otherwise none is acknowledged, and all stations get the default grant.
    """

    def __init__(
        self,
        prisms: Mapping[int, int],
        timing: FrameTiming,
        authenticator: Authenticator,
        random_bits: Callable[[int], int],
        now_ns: int,
        *,
        phase_lock: PhaseLock | None = None,
        records: bool = True,
    ) -> None:
        symbol_ns = timing.settings.symbol_ns
        interval = math.ceil(len(prisms) / EXCHANGES_PER_FRAME)
        self._stations = {
            number: StationState(
                number,
                prism,
                StationTiming(LinkDelayEstimator(timing.link_ns, symbol_ns), now_ns),
                DemandEstimator(number, interval),
            )
            for number, prism in prisms.items()
        }
        self._entries = max(prisms)
        self._timing = timing
        self._max_grant = max_grant(timing, len(prisms))
        self._authenticator = authenticator
        self._random_bits = random_bits
        self._zero_ns = now_ns
        self._phase_lock = phase_lock
        self._records = records
        self._slot_order = SlotOrder()
        self._frame = self._next = _initial_frame(now_ns)
        self.rejected_packets = self.other_beacons = 0
        self.session = random_bits(NONCE_BITS)
        self.counter = -1

    def station(self, number: int) -> StationState:
        """Return the state of a station."""
        return self._stations[number]

    # --- Beacons --------------------------------------------------------------------------------------------------

    def prepare(self, earliest_ns: int) -> int:
        """Plan the next frame; return the start of its beacon, at the earliest ``earliest_ns``."""
        if self.counter + 1 >= MAX_FRAMES_PER_SESSION:
            self._begin_session()
        counter = self.counter + 1
        draft = self._draft(counter)
        beacon_bytes = len(encode_beacon(draft)) + CODE_BYTES
        if not any(self._frame.grants):
            earliest_ns = max(earliest_ns, self._frame.start_ns + IDLE_FRAME_NS)
        start_ns = earliest_ns
        if self._phase_lock is not None:  # a later start increases the demand
            start_ns = self._zero_ns + self._phase_lock.forecast(earliest_ns - self._zero_ns, beacon_bytes)
        invites = draft.session is not None
        grants = self._grants(counter, start_ns, beacon_bytes, invites=invites)
        if self._phase_lock is not None and any(grants):
            plan = self._phase_lock.plan(earliest_ns - self._zero_ns, grants, beacon_bytes)
            start_ns, self._slot_order = self._zero_ns + plan.start_ns, plan.slot_order
            # The demand depends on the start of the slots.
            grants = self._grants(counter, start_ns, beacon_bytes, invites=invites)
        self._next = _Frame(counter, start_ns, grants, self._slot_order, draft)
        return start_ns

    def compose(self) -> bytes:
        """Start the prepared frame; return its beacon."""
        frame = self._next
        entries = []
        for index, grant in enumerate(frame.grants):
            station = self._stations.get(index + 1)
            ack_bitmap = 0 if station is None else station.window.ack_bitmap(frame.counter)
            entries.append(StationEntry(ack_bitmap, grant))
            if grant and station is not None:
                frame.pending[index] = station
        acknowledged = self._stations.get(frame.counter % self._entries + 1)
        content = encode_beacon(
            replace(
                frame.draft,
                cumulative=0 if acknowledged is None else acknowledged.window.cumulative % 256,
                slot_order=frame.slot_order,
                stations=tuple(entries),
            )
        )
        frame.code = self._authenticator.beacon_code(
            session=self.session, counter=frame.counter, content=content
        )
        frame.slots = self._timing.slots(frame.grants, frame.slot_order)
        self.counter, self._frame = frame.counter, frame
        return content + frame.code

    def sent(self, done_ns: int, sigma_ns: int) -> None:
        """Take TxDone of the beacon; an inexact one is not sent to the stations."""
        frame = self._frame
        frame.sent_ns, frame.sent_sigma_ns = done_ns, sigma_ns
        for confirmation in frame.draft.confirmations:
            self._stations[confirmation.station].confirmation_sent()

    # --- Replies --------------------------------------------------------------------------------------------------

    @property
    def reply_deadline_ns(self) -> int | None:
        """Latest RxDone of a reply in this frame; None when all have been received."""
        frame, timing = self._frame, self._timing
        ends_ns = [slot.end_ns for index in frame.pending if (slot := frame.slots[index]) is not None]
        if not ends_ns or frame.sent_ns is None:
            return None
        return frame.sent_ns - TX_DONE_NS + max(ends_ns) + timing.guard_ns + timing.reception_ns

    def received(self, payload: bytes, received_ns: int, sigma_ns: int) -> ReceivedReply | None:
        """Take a packet with its RxDone; return its content, None if it is no reply to this frame's beacon."""
        frame = self._frame
        received = None
        if frame.sent_ns is not None and received_ns > frame.sent_ns:
            received = self._take_reply(frame, frame.sent_ns, payload, received_ns, sigma_ns)
        if received is None:
            self.rejected_packets += 1
            self.other_beacons += self._is_other_beacon(payload)
        return received

    def _is_other_beacon(self, payload: bytes) -> bool:
        """Whether a packet is an authentic beacon of another session; recognised by those with a session item only."""
        content, code = payload[:-CODE_BYTES], payload[-CODE_BYTES:]
        try:
            beacon = decode_beacon(content)
        except MessageError:
            return False
        info = beacon.session
        if info is None or info.nonce == self.session:
            return False
        expected = self._authenticator.beacon_code(
            session=info.nonce, counter=full_counter(info, beacon), content=content
        )
        return hmac.compare_digest(expected, code)

    def _take_reply(
        self, frame: _Frame, sent_ns: int, payload: bytes, received_ns: int, sigma_ns: int
    ) -> ReceivedReply | None:
        content, code = payload[:-CODE_BYTES], payload[-CODE_BYTES:]
        try:
            reply = decode_reply(content)
        except MessageError:
            return None
        index = next(
            (
                i
                for i, station in frame.pending.items()
                if self._matches(station, frame, reply, content, code)
            ),
            None,
        )
        slot = None if index is None else frame.slots[index]
        if index is None or slot is None:
            return None
        slot_ns = sent_ns - TX_DONE_NS + slot.start_ns
        airtime_ns = self._timing.airtime_ns(len(payload))
        at = ReplyTiming(
            counter=frame.counter,
            sent_ns=sent_ns,
            sent_sigma_ns=frame.sent_sigma_ns,
            slot_ns=slot_ns,
            received_ns=received_ns,
            received_sigma_ns=sigma_ns,
            lateness_ns=received_ns - slot_ns - airtime_ns - self._timing.reception_ns,
            payload_bytes=len(payload),
            granted_bytes=slot.max_reply_bytes,
        )
        if frame.pending[index].timing.is_ambiguous(reply, at):
            return None
        received = frame.pending.pop(index).take(reply, at)
        if self._phase_lock is not None:
            self._phase_lock.reply_received(index)
            for measurement in received.measurements:
                self._phase_lock.add_measurement(index, (measurement.measured_ns - self._zero_ns) // 1000)
        return received

    def _matches(
        self, station: StationState, frame: _Frame, reply: Reply, content: bytes, code: bytes
    ) -> bool:
        """Whether a reply's authentication code is this station's in this frame."""
        nonce = station.nonce if reply.join_request is None else reply.join_request.nonce
        if nonce is None:
            return False
        expected = self._authenticator.reply_code(
            session=self.session,
            station=station.number,
            station_nonce=nonce,
            counter=frame.counter,
            beacon_code=frame.code,
            sequence=station.first_sequence(reply),
            content=content,
        )
        return hmac.compare_digest(expected, code)

    def finish(self) -> list[int]:
        """End the frame; return the stations that had a slot and were silent."""
        silent = list(self._frame.pending.values())
        self._frame.pending = {}
        for station in silent:
            station.silent_frames += 1
        return [station.number for station in silent]

    # --- Contents of a beacon -------------------------------------------------------------------------------------

    def _draft(self, counter: int) -> Beacon:
        """Return the next beacon without station entries, slot order and cumulative acknowledgement."""
        before, sent_us = self._frame, 0
        if before.sent_ns is not None and before.sent_sigma_ns <= EXACT_SIGMA_NS:
            sent_us = (before.sent_ns - self._zero_ns + 500) // 1000 % (1 << SESSION_TIME_BITS)
            sent_us += not sent_us % (1 << 16)  # low bits 0 mean unknown
        stations = self._stations.values()
        incomplete = any(
            station.nonce is None
            or station.join_pending
            or station.lacks_time
            or station.silent_frames > REJOIN_FRAMES
            for station in stations
        )
        interval = SESSION_INTERVAL_JOINING if incomplete else SESSION_INTERVAL
        invites = (
            any(station.needs_full_time(counter) for station in stations)
            or (incomplete and counter < SESSION_STARTUP_FRAMES)
            or counter % interval == 0
        )
        commands = (station.encoded_command for station in stations)
        session = SessionInfo(
            nonce=self.session,
            counter_high=counter >> 8,
            sent_high=sent_us >> 16,
            guard=self._timing.guard_ns // GUARD_UNIT_NS,
            turnaround=self._timing.turnaround_ns // GUARD_UNIT_NS,
        )
        return Beacon(
            frame=counter % 256,
            sent=sent_us % (1 << 16),
            cumulative=0,
            slot_order=SlotOrder(),
            stations=(StationEntry(0, 0),) * self._entries,
            session=session if invites else None,
            confirmations=tuple(each.confirmation for each in stations if each.confirmation is not None),
            commands=tuple(each for each in commands if each is not None),
        )

    def _grants(self, counter: int, start_ns: int, beacon_bytes: int, *, invites: bool) -> tuple[int, ...]:
        """Return the grants by station index for a beacon with this start."""
        grants = [0] * self._entries
        slot_ns = start_ns + self._timing.airtime_ns(beacon_bytes) + self._timing.turnaround_ns
        silent_frames = {number - 1: station.silent_frames for number, station in self._stations.items()}
        retries = retry_stations(silent_frames, self._frame.grants)
        for index in slot_sequence(self._entries, self._slot_order):
            station = self._stations.get(index + 1)
            if station is None or (station.silent_frames > ABSENT_FRAMES and not invites):
                continue
            if retries and index not in retries:
                continue
            grants[index] = DEFAULT_GRANT
            if self._records:
                grants[index] = station.grant(counter, slot_ns, cap=self._max_grant)
            slot_ns += self._timing.airtime_ns(GRANT_BYTES[grants[index]]) + self._timing.guard_ns
        return tuple(grants)

    def _begin_session(self) -> None:
        self.session = self._random_bits(NONCE_BITS)
        self.counter = -1
        self._frame = _initial_frame(self._frame.start_ns)
        for station in self._stations.values():
            station.reset_session()


def _initial_frame(start_ns: int) -> _Frame:
    """Return a placeholder for the frame before the first one."""
    draft = Beacon(frame=0, sent=0, cumulative=0, slot_order=SlotOrder(), stations=())
    return _Frame(-1, start_ns - IDLE_FRAME_NS, (), SlotOrder(), draft)
