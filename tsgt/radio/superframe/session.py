"""One session of a master at a station: clock, acknowledgements, timestamps, slots. Sans-I/O."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from itertools import islice, takewhile
from math import inf
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.command_exchange import CommandExchange
from tsgt.radio.superframe.send_queue import (
    NO_REACH,
    DeliveryProgress,
    StampedMeasurement,
    quality_of,
)
from tsgt.radio.superframe.slots import GUARD_UNIT_NS, FrameTiming
from tsgt.radio.superframe.wire import (
    ACK_FRAMES,
    SESSION_TIME_BITS,
    TIME_UNIT_US,
    TURNAROUND_BITS,
    JoinConfirmation,
)
from tsgt.timesync import BeaconClock

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.radio.base import LoRaSettings
    from tsgt.radio.superframe.send_queue import QueuedMeasurement, SendQueue
    from tsgt.radio.superframe.slots import Slot
    from tsgt.radio.superframe.wire import Beacon, Reply, SessionInfo

MAX_SLOT_SIGMA_NS = 1_000_000  # a beacon with a less exact timestamp gives no slot

_FRAME_BITS = 8
_SENT_BITS = 16

_BEACON_RELATIVE_EXTRA_US = 2000.0
"""Additional error of a beacon-relative time: the start jitter of the reply."""

_MAX_REACH_NS = int(4.4 * 3600e9)
"""Measurements made longer before the first beacon have no timestamp within half a second, whatever the skew bound."""

_MAX_EARLIER_REACH_NS = 1 << 45
"""9.8 hours: no bound is half a second that far from the beacons of an earlier boot."""

_MAX_DISCARDED = 50  # oldest measurements that one beacon discards; with more its reply might be late

_USEFUL_BEACONS_NS = 60_000_000_000  # beacons later than this after an instant do not improve its timestamp

_SIGMAS = 4  # sigmas in a bound


@dataclass(frozen=True, slots=True, kw_only=True)
class BeaconReception:
    """A clock sample: a beacon's TxDone on the master's clock and its RxDone on the station's."""

    session: int  # session nonce
    counter: int
    received_ns: int  # RxDone on CLOCK_MONOTONIC of the station's computer
    sigma_ns: int
    sent_us: int  # TxDone in session time
    boot: str  # boot id of the station's clock


class AuthenticBeacon(NamedTuple):
    """An authenticated beacon with its RxDone on CLOCK_MONOTONIC."""

    beacon: Beacon
    code: bytes
    counter: int
    received_ns: int
    sigma_ns: int


class ReplySlot(NamedTuple):
    """The station's slot on its CLOCK_MONOTONIC."""

    slot: Slot
    beacon_end_ns: int  # on the air
    start_ns: int


@dataclass(frozen=True, slots=True)
class ReceivedBeacon:
    """Result of an authentic beacon."""

    slot_ns: int | None  # start of the station's slot on its CLOCK_MONOTONIC
    reception: BeaconReception | None  # clock sample of the previous beacon, for the journal
    time_rejected: bool  # the time of the previous beacon is impossible
    joined: bool  # the beacon confirms the station
    discarded: int  # measurements removed from the queue because they cannot be timestamped for this master


@dataclass(slots=True)
class SentReply:
    """A reply that was sent; ``done_ns`` is its TxDone on CLOCK_MONOTONIC if that is exact."""

    beacon: AuthenticBeacon
    reply: Reply
    sequences: tuple[int, ...]
    done_ns: int | None = None


class StationSession:
    """One session of a master.

    ``confirmed``: a beacon has repeated the station's nonce: the session is not a replay. ``beacon``, ``slot``: the
    newest beacon, and the slot for the reply to it. ``untimed``: what the last reply left out for want of a timestamp.

    Parameters
    ----------
    beacon, info
        The first beacon, and its session item.
    nonce
        The station's nonce in this session, 32 bits.
    boot, clocks
        The present boot id, and the clocks of this session by boot id, from journalled receptions.
    """

    def __init__(
        self,
        station: int,
        beacon: AuthenticBeacon,
        info: SessionInfo,
        nonce: int,
        settings: LoRaSettings,
        send_queue: SendQueue,
        boot: str,
        clocks: Mapping[str, BeaconClock],
    ) -> None:
        self.master_nonce = info.nonce
        self.nonce = nonce
        self.confirmed = False
        self.beacon = beacon
        self.slot: ReplySlot | None = None
        self.timing = _frame_timing(settings, info)
        self._station = station
        self._previous: AuthenticBeacon | None = None
        self._boot = boot
        self._queue = send_queue
        self._clocks = dict(clocks)
        self._earlier_reaches = {each: _reach(clock) for each, clock in clocks.items() if each != boot}
        self.clock = self._clocks.setdefault(boot, BeaconClock())
        self.untimed: list[QueuedMeasurement] = []
        self.delivery = DeliveryProgress(send_queue, self.reach)
        self.commands = CommandExchange()
        self.last_reply: SentReply | None = None
        self._unacknowledged: deque[SentReply] = deque(maxlen=ACK_FRAMES)
        self._queue_checked = False

    def counter_of(self, beacon: Beacon) -> int | None:
        """Return the frame counter of a beacon; None if it is of another session or not newer than the newest."""
        if beacon.session is None:
            following = self.beacon.counter + 1
            return following + (beacon.frame - following) % (1 << _FRAME_BITS)
        counter = full_counter(beacon.session, beacon)
        same_session = beacon.session.nonce == self.master_nonce
        return counter if same_session and counter > self.beacon.counter else None

    def take(self, authentic: AuthenticBeacon) -> ReceivedBeacon:
        """Take an authentic beacon of this session."""
        beacon = authentic.beacon
        if authentic is not self.beacon:
            self._previous, self.beacon = self.beacon, authentic
            if beacon.session is not None:
                self.timing = _frame_timing(self.timing.settings, beacon.session)
        joined = self._confirm(beacon)
        discarded = self._queue.retain(self.reach) if joined else 0
        reception = self.reception()
        time_rejected = reception is not None and not self._add_sample(reception)
        if time_rejected:
            self.commands.request_turnaround()
        if self.confirmed:
            self._take_acknowledgements(beacon)
            self.commands.receive(each for each in beacon.commands if each.station == self._station)
        discarded += self._discard_untimeable()
        self.slot = self._reply_slot()
        return ReceivedBeacon(
            slot_ns=None if self.slot is None else self.slot.start_ns,
            reception=None if time_rejected else reception,
            time_rejected=time_rejected,
            joined=joined,
            discarded=discarded,
        )

    def _confirm(self, beacon: Beacon) -> bool:
        """Return whether the beacon confirms the session for the first time."""
        confirmation = JoinConfirmation(self._station, self.nonce)
        joined = not self.confirmed and confirmation in beacon.confirmations
        self.confirmed = self.confirmed or joined
        return joined

    def reception(self) -> BeaconReception | None:
        """Return the clock sample of the previous beacon; None before the session is confirmed: it may be a replay."""
        before, beacon = self._previous, self.beacon.beacon
        follows = before is not None and before.counter + 1 == self.beacon.counter
        if before is None or not follows or not self.confirmed or not beacon.sent:
            return None
        sent_us = self._unwrap(before, beacon)
        if sent_us is None:
            return None
        return BeaconReception(
            session=self.master_nonce,
            counter=before.counter,
            received_ns=before.received_ns,
            sigma_ns=before.sigma_ns,
            sent_us=sent_us,
            boot=self._boot,
        )

    def _unwrap(self, before: AuthenticBeacon, beacon: Beacon) -> int | None:
        if beacon.session is None:
            return self.clock.unwrap(before.received_ns, beacon.sent, before.sigma_ns)
        sent_us = beacon.session.sent_high << _SENT_BITS | beacon.sent
        now = self.clock.at(before.received_ns)
        if now is None:
            return sent_us
        half = 1 << SESSION_TIME_BITS - 1  # session time wraps after 12.7 days
        return sent_us + (round(now.time_us) - sent_us + half >> SESSION_TIME_BITS << SESSION_TIME_BITS)

    def _add_sample(self, reception: BeaconReception) -> bool:
        """Add a clock sample; return False if the clock rejects it."""
        beacon, mine = self.beacon.beacon, self._station - 1
        return self.clock.add(
            reception.received_ns,
            reception.sent_us,
            reception.sigma_ns,
            unambiguous=beacon.session is not None,
            live=mine < len(beacon.stations) and bool(beacon.stations[mine].ack_bitmap & 1),
        )

    def _reply_slot(self) -> ReplySlot | None:
        received, entries = self.beacon, self.beacon.beacon.stations
        if self._station > len(entries) or received.sigma_ns > MAX_SLOT_SIGMA_NS:
            return None
        grants = [entry.grant for entry in entries]
        slot = self.timing.slots(grants, received.beacon.slot_order)[self._station - 1]
        if slot is None:
            return None
        end_ns = received.received_ns - self.timing.reception_ns
        return ReplySlot(slot, end_ns, end_ns + slot.start_ns)

    def reply_sent(self, reply: Reply, sequences: tuple[int, ...]) -> None:
        """Take the reply to the newest beacon as sent."""
        self.last_reply = SentReply(self.beacon, reply, sequences)
        self._unacknowledged.append(self.last_reply)
        self.delivery.mark_sent(sequences)
        self.commands.sent(reply, self.beacon.counter)

    def _take_acknowledgements(self, beacon: Beacon) -> None:
        mine = self._station - 1
        if mine >= len(beacon.stations):
            return
        for sent in list(self._unacknowledged):
            age = self.beacon.counter - sent.beacon.counter - 1
            if age < ACK_FRAMES and beacon.stations[mine].ack_bitmap >> age & 1:
                self._unacknowledged.remove(sent)
                self.delivery.acknowledge(sent.sequences)
                if sent.reply.join_request is not None:
                    self.delivery.join_acknowledged(sent.reply.join_request.oldest)
                self.commands.acknowledged(sent.reply, sent.beacon.counter)
        if self.beacon.counter % len(beacon.stations) == mine:
            self.delivery.acknowledge_through(beacon.cumulative)

    def reach(self, boot: str) -> tuple[float, float]:
        """Return between which times, on the clock of a boot, measurements have or may soon have a time on the master's.

        Those outside are too far from all beacons for any quality. Some inside may be too, between beacons many hours apart.
        """
        if boot != self._boot:
            return self._earlier_reaches.get(boot, NO_REACH)
        first_ns = self.clock.first_received_ns
        return -inf if first_ns is None else first_ns - _MAX_REACH_NS, inf

    def _discard_untimeable(self) -> int:
        """Discard measurements that will never have a timestamp, not all at once; return how many."""
        if not self.confirmed or not self.clock.converged:
            return 0
        before = len(self._queue)
        if not self._queue_checked:
            self._queue.retain(self.reach)
            self._queue_checked = True
        oldest = islice(self._queue.oldest_first(), _MAX_DISCARDED)
        # No beacon improves the clock of an earlier boot.
        earlier = [queued for queued in self.untimed if queued.boot != self._boot]
        untimeable = [*takewhile(self._is_untimeable, oldest), *earlier]
        self._queue.remove(queued.sequence for queued in untimeable)
        discarded = before - len(self._queue)
        if discarded:
            self.delivery.request_join()
        return discarded

    def _is_untimeable(self, queued: QueuedMeasurement) -> bool:
        """Whether a measurement has no useful timestamp, and later beacons will not improve it."""
        first_ns, last_ns = self.clock.first_received_ns, self.clock.last_received_ns
        if queued.boot != self._boot or first_ns is None or last_ns is None:
            return False
        final = last_ns - max(first_ns, queued.at_ns) > _USEFUL_BEACONS_NS
        return final and self.timestamped(queued, self.beacon.received_ns) is None

    def timestamped(
        self, queued: QueuedMeasurement, slot_ns: int, newest: StampedMeasurement | None = None
    ) -> StampedMeasurement | None:
        """Return a measurement with its time for a slot that starts then; None without a useful one.

        A block has either session times or beacon-relative ones, so a measurement prefers the kind of the reply's newest.
        Before the clock has converged all times are beacon-relative: the beacons may have been delayed, and the master
        adds the lateness of the reply to the bound of such times.
        """
        clock = self._clocks[queued.boot]
        same_boot = queued.boot == self._boot
        time = clock.at(queued.at_ns) if clock.converged else None
        beacon_relative = False
        extra_us = 0.0 if newest is not None and newest.beacon_relative else _BEACON_RELATIVE_EXTRA_US
        try_relative = same_boot
        if newest is not None and not newest.beacon_relative:
            try_relative = same_boot and time is None
        if try_relative and (time is None or time.bound_us > extra_us):
            elapsed = clock.elapsed(self.beacon.received_ns, queued.at_ns)
            timestamp_us = _SIGMAS * self.beacon.sigma_ns / 1000
            if time is None or elapsed.bound_us + timestamp_us + extra_us < time.bound_us:
                time, beacon_relative = elapsed._replace(bound_us=elapsed.bound_us + timestamp_us), True
        quality = None if time is None else quality_of(time.bound_us)
        if time is None or quality is None:
            return None
        age_ns = slot_ns - queued.at_ns if same_boot else None
        return StampedMeasurement(
            queued, round(time.time_us / TIME_UNIT_US), quality, beacon_relative, age_ns
        )

    def turnaround_us(self) -> int | None:
        """Return the turnaround of the previous frame: from RxDone of its beacon to TxDone of its reply."""
        last = self.last_reply
        if last is None or last.done_ns is None or last.beacon.counter + 1 != self.beacon.counter:
            return None
        turnaround_us = round(self.clock.elapsed(last.beacon.received_ns, last.done_ns).time_us)
        return turnaround_us if turnaround_us < 1 << TURNAROUND_BITS else None


def _reach(clock: BeaconClock) -> tuple[float, float]:
    """Return between which times the clock of an earlier boot is known.

    It must have converged: otherwise its beacons may have been delayed, and no later one can show it. The bound of its
    time increases with the distance from the first and the last beacon.
    """
    first_ns, last_ns = clock.first_received_ns, clock.last_received_ns
    if not clock.converged or first_ns is None or last_ns is None:
        return NO_REACH

    def unknown(at_ns: int) -> bool:
        time = clock.at(at_ns)
        return time is None or quality_of(time.bound_us) is None

    distances_ns = range(_MAX_EARLIER_REACH_NS)
    before_ns = bisect_left(distances_ns, True, key=lambda distance_ns: unknown(first_ns - distance_ns))
    after_ns = bisect_left(distances_ns, True, key=lambda distance_ns: unknown(last_ns + distance_ns))
    return first_ns - before_ns + 1, last_ns + after_ns - 1


def _frame_timing(settings: LoRaSettings, info: SessionInfo) -> FrameTiming:
    return FrameTiming(settings, info.guard * GUARD_UNIT_NS, info.turnaround * GUARD_UNIT_NS)


def full_counter(info: SessionInfo, beacon: Beacon) -> int:
    """Return the full frame counter of a beacon with a session item."""
    return info.counter_high << _FRAME_BITS | beacon.frame
