"""The master's side of the superframe: beacons out, replies in. Pure: instants and random bits are handed in.

Each frame goes the same way. :meth:`SuperframeMaster.prepare` decides who gets which slot and when the beacon should
begin. :meth:`~SuperframeMaster.compose` makes the beacon, as late as possible, so that it acknowledges what was written
until then. :meth:`~SuperframeMaster.sent` says when it was out; :meth:`~SuperframeMaster.received` takes what comes back
until all slots are over; :meth:`~SuperframeMaster.finished` names those who were silent. A frame may break off at any
point: the next one begins with ``prepare`` again, and nothing that was acknowledged is taken back.

A reply does not name its station. It is that one's whose code fits: the code covers session, frame, beacon and station,
so that a packet of another frame, another station, or somebody without the key fits none.
"""

from __future__ import annotations

import hmac
import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from tsgt.errors import MessageError
from tsgt.radio.airtime import TX_DONE_NS, symbol_time_ns
from tsgt.radio.superframe.grants import UNKNOWN_GRANT, asked_again, longest_grant
from tsgt.radio.superframe.slots import GUARD_UNIT_NS, slot_sequence
from tsgt.radio.superframe.station_state import EXACT_SIGMA_NS, Peer, Reception
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    GRANT_BYTES,
    SESSION_TIME_BITS,
    Beacon,
    SessionPart,
    SlotOrder,
    StationEntry,
    decode_reply,
    encode_beacon,
)
from tsgt.timesync import RoundTrip

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from tsgt.radio.commands import Order
    from tsgt.radio.superframe.phase_lock import FrameLock
    from tsgt.radio.superframe.reception import Heard
    from tsgt.radio.superframe.slots import FrameTiming, SlotSpan
    from tsgt.radio.superframe.wire import Authenticator, Reply

NONCE_BITS = 48

FRAMES_PER_SESSION = (1 << 24) - 1
"""The frame counter has 24 bits on the air; before it would begin again, a new session does."""

SESSION_EVERY = 32
SESSION_EVERY_WANTED = 4
SESSION_AT_START = 12
"""Each so manieth beacon says what a station needs to join; more often while one is not there, and at the start each."""

CALIBRATED_AT_ONCE = 3
"""More stations than this do not make their replies longer for the first self-calibrations in the same frame."""

WANTED_AFTER_FRAMES = 4
"""A station that was silent for longer may have to join again."""

ABSENT_AFTER_FRAMES = 20
"""A station that was silent for longer has a slot only in frames whose beacon it could join by."""

IDLE_FRAME_NS = 400_000_000
"""How long a frame lasts in which nobody has a slot."""


@dataclass(slots=True)
class _Frame:
    """A frame under way; instants on the master's CLOCK_MONOTONIC.

    Attributes
    ----------
    counter
        Its number in the session.
    start_ns
        When its beacon is to begin.
    grants, order
        Of its slots.
    draft
        Its beacon as far as it is known beforehand.
    code
        Of the beacon, when it is composed.
    sent_ns, sent_sigma_ns
        TxDone of the beacon; None before.
    spans
        The slots, by index of the station.
    open
        The stations that have a slot and have not been heard.
    """

    counter: int
    start_ns: int
    grants: tuple[int, ...]
    order: SlotOrder
    draft: Beacon
    code: bytes = b""
    sent_ns: int | None = None
    sent_sigma_ns: int = 0
    spans: list[SlotSpan | None] = field(default_factory=list)
    open: dict[int, Peer] = field(default_factory=dict)


class SuperframeMaster:
    """Runs the frames of a session, and the next session when its numbers are used up.

    Parameters
    ----------
    prisms
        Number of the prism by number of the station, 1 to 16, that tracks it unless it says otherwise.
    timing
        Of the frames.
    authenticator
        Makes the codes.
    random_bits
        Returns so many random bits, for nonces.
    now_ns
        The present on the master's CLOCK_MONOTONIC in ns, as all instants here. The session time begins here.
    lock
        Says when frames begin; None: each as soon as it can.
    records
        Measurements are written. Otherwise none is acknowledged, and stations are granted what answers to orders need.

    Attributes
    ----------
    session
        The nonce of the session.
    counter
        Number of the present frame in the session; -1 before the first.
    foreign
        How many packets were not what this frame waits for: of others, forged, late, repeated.
    """

    def __init__(
        self,
        prisms: Mapping[int, int],
        timing: FrameTiming,
        authenticator: Authenticator,
        random_bits: Callable[[int], int],
        now_ns: int,
        *,
        lock: FrameLock | None = None,
        records: bool = True,
    ) -> None:
        symbol_ns = symbol_time_ns(timing.settings.spreading_factor, timing.settings.bandwidth_hz)
        pace = math.ceil(len(prisms) / CALIBRATED_AT_ONCE)
        self._peers = {
            number: Peer(number, prism, RoundTrip(timing.link_ns, symbol_ns), now_ns, pace)
            for number, prism in prisms.items()
        }
        self._entries = max(prisms)
        self._timing = timing
        self._cap = longest_grant(timing, len(prisms))
        self._authenticator = authenticator
        self._random_bits = random_bits
        self._zero_ns = now_ns
        self._lock = lock
        self._records = records
        self._order = SlotOrder()
        self._frame = self._next = _no_frame(now_ns)
        self.foreign = 0
        self.session = random_bits(NONCE_BITS)
        self.counter = -1

    def peer(self, station: int) -> Peer:
        """Return what is known of a station."""
        return self._peers[station]

    def order(self, station: int, order: Order) -> int:
        """Give a station an order, in the place of one that it has not answered; return its ticket.

        The answer comes in :attr:`~tsgt.radio.superframe.reception.Heard.answer`, or ``shot``, of the same ticket.
        """
        return self._peers[station].order(order)

    # --- Beacons --------------------------------------------------------------------------------------------------

    def prepare(self, earliest_ns: int) -> int:
        """Plan the next frame; return when its beacon should begin.

        Parameters
        ----------
        earliest_ns
            Before this it cannot.
        """
        if self.counter + 1 >= FRAMES_PER_SESSION:
            self._begin_session()
        counter = self.counter + 1
        draft = self._draft(counter)
        beacon_bytes = len(encode_beacon(draft)) + CODE_BYTES
        if not any(self._frame.grants):
            earliest_ns = max(earliest_ns, self._frame.start_ns + IDLE_FRAME_NS)
        start_ns = earliest_ns
        if self._lock is not None:  # the longer a frame waits, the more there is to say in it
            start_ns = self._zero_ns + self._lock.forecast(earliest_ns - self._zero_ns, beacon_bytes)
        grants = self._grants(counter, start_ns, beacon_bytes, invites=draft.session is not None)
        if self._lock is not None and any(grants):
            plan = self._lock.plan(earliest_ns - self._zero_ns, grants, beacon_bytes)
            start_ns, self._order = self._zero_ns + plan.start_ns, plan.order
            # In another order, or later than was foreseen, the stations will have more to say.
            grants = self._grants(counter, start_ns, beacon_bytes, invites=draft.session is not None)
        self._next = _Frame(counter, start_ns, grants, self._order, draft)
        return start_ns

    def compose(self) -> bytes:
        """Return the beacon of the frame that was prepared; the frame begins."""
        frame = self._next
        entries = []
        for index, grant in enumerate(frame.grants):
            peer = self._peers.get(index + 1)
            history = 0 if peer is None else peer.history(frame.counter)
            entries.append(StationEntry(history, grant))
            if grant and peer is not None:
                frame.open[index] = peer
        of_all = self._peers.get(frame.counter % self._entries + 1)
        content = encode_beacon(
            replace(
                frame.draft,
                cumulative=0 if of_all is None else of_all.inbox.cumulative % 256,
                order=frame.order,
                stations=tuple(entries),
            )
        )
        frame.code = self._authenticator.beacon_code(
            session=self.session, counter=frame.counter, content=content
        )
        frame.spans = self._timing.slots(frame.grants, frame.order)
        self.counter, self._frame = frame.counter, frame
        return content + frame.code

    def sent(self, done_ns: int, sigma_ns: int) -> None:
        """Take TxDone of the beacon.

        Parameters
        ----------
        done_ns, sigma_ns
            As the radio says; one that was found without its edge is not told to the stations.
        """
        frame = self._frame
        frame.sent_ns, frame.sent_sigma_ns = done_ns, sigma_ns
        for confirmation in frame.draft.confirmations:
            self._peers[confirmation.station].confirmed()

    # --- Replies --------------------------------------------------------------------------------------------------

    @property
    def waits_until_ns(self) -> int | None:
        """Until when a reply to this frame's beacon may come; None when all have come."""
        frame, timing = self._frame, self._timing
        ends_ns = [span.end_ns for index in frame.open if (span := frame.spans[index]) is not None]
        if not ends_ns or frame.sent_ns is None:
            return None
        return frame.sent_ns - TX_DONE_NS + max(ends_ns) + timing.guard_ns + timing.reception_ns

    def received(self, payload: bytes, received_ns: int, sigma_ns: int) -> Heard | None:
        """Take a packet; return what it brought, None where it is no reply to this frame's beacon.

        Parameters
        ----------
        payload
            As it came.
        received_ns, sigma_ns
            RxDone, and one sigma of it.
        """
        frame = self._frame
        heard = None
        if frame.sent_ns is not None and received_ns > frame.sent_ns:
            heard = self._reply(frame, frame.sent_ns, payload, received_ns, sigma_ns)
        self.foreign += heard is None
        return heard

    def _reply(
        self, frame: _Frame, sent_ns: int, payload: bytes, received_ns: int, sigma_ns: int
    ) -> Heard | None:
        content, code = payload[:-CODE_BYTES], payload[-CODE_BYTES:]
        try:
            reply = decode_reply(content)
        except MessageError:
            return None
        index = next(
            (i for i, peer in frame.open.items() if self._fits(peer, frame, reply, content, code)), None
        )
        span = None if index is None else frame.spans[index]
        if index is None or span is None:
            return None
        slot_ns = sent_ns - TX_DONE_NS + span.start_ns
        airtime_ns = self._timing.airtime_ns(len(payload))
        at = Reception(
            counter=frame.counter,
            sent_ns=sent_ns,
            sent_sigma_ns=frame.sent_sigma_ns,
            slot_ns=slot_ns,
            received_ns=received_ns,
            received_sigma_ns=sigma_ns,
            lateness_ns=received_ns - slot_ns - airtime_ns - self._timing.reception_ns,
            payload_bytes=len(payload),
            granted_bytes=span.reply_bytes,
        )
        if frame.open[index].may_be_older(reply, at):
            return None
        heard = frame.open.pop(index).take(reply, at)
        if self._lock is not None:
            self._lock.answered(index)
            for sighting in heard.sightings:
                self._lock.measured(index, (sighting.measured_ns - self._zero_ns) // 1000)
        return heard

    def _fits(self, peer: Peer, frame: _Frame, reply: Reply, content: bytes, code: bytes) -> bool:
        """Tell whether a reply's code is this station's in this frame."""
        nonce = peer.nonce if reply.introduction is None else reply.introduction.nonce
        if nonce is None:
            return False
        right = self._authenticator.reply_code(
            session=self.session,
            station=peer.number,
            station_nonce=nonce,
            counter=frame.counter,
            beacon_code=frame.code,
            sequence=peer.first_number(reply),
            content=content,
        )
        return hmac.compare_digest(right, code)

    def finished(self) -> list[int]:
        """End the frame; return the stations that had a slot and were silent."""
        silent = list(self._frame.open.values())
        self._frame.open = {}
        for peer in silent:
            peer.silent += 1
        return [peer.number for peer in silent]

    # --- What a beacon says ---------------------------------------------------------------------------------------

    def _draft(self, counter: int) -> Beacon:
        """Return the next beacon but for what is not known yet: entries, order, cumulative."""
        before, sent_us = self._frame, 0
        if before.sent_ns is not None and before.sent_sigma_ns <= EXACT_SIGMA_NS:
            sent_us = (before.sent_ns - self._zero_ns + 500) // 1000 % (1 << SESSION_TIME_BITS)
            sent_us += not sent_us % (1 << 16)  # 0 stands for not known
        peers = self._peers.values()
        wanted = any(
            peer.nonce is None or peer.introducing or peer.lacks_time or peer.silent > WANTED_AFTER_FRAMES
            for peer in peers
        )
        at_once = any(peer.wants_time(counter) for peer in peers)
        at_the_start = wanted and counter < SESSION_AT_START
        invites = (
            at_once or at_the_start or counter % (SESSION_EVERY_WANTED if wanted else SESSION_EVERY) == 0
        )
        session = SessionPart(
            nonce=self.session,
            counter_high=counter >> 8,
            sent_high=sent_us >> 16,
            guard=self._timing.guard_ns // GUARD_UNIT_NS,
            turn_round=self._timing.turn_round_ns // GUARD_UNIT_NS,
        )
        confirmations = (peer.confirmation for peer in peers)
        orders = (peer.order_part for peer in peers)
        return Beacon(
            frame=counter % 256,
            sent=sent_us % (1 << 16),
            cumulative=0,
            order=SlotOrder(),
            stations=(StationEntry(0, 0),) * self._entries,
            session=session if invites else None,
            confirmations=tuple(part for part in confirmations if part is not None),
            orders=tuple(part for part in orders if part is not None),
        )

    def _grants(self, counter: int, start_ns: int, beacon_bytes: int, *, invites: bool) -> tuple[int, ...]:
        """Return the grants by index for a beacon that begins then."""
        grants = [0] * self._entries
        slot_ns = start_ns + self._timing.airtime_ns(beacon_bytes) + self._timing.turn_round_ns
        silent = {number - 1: peer.silent for number, peer in self._peers.items()}
        again = asked_again(silent, self._frame.grants)
        for index in slot_sequence(self._entries, self._order):
            peer = self._peers.get(index + 1)
            if peer is None or (peer.silent > ABSENT_AFTER_FRAMES and not invites):
                continue
            if again and index not in again:
                continue
            grants[index] = UNKNOWN_GRANT
            if self._records:
                grants[index] = peer.grant(counter, slot_ns, cap=self._cap)
            slot_ns += self._timing.airtime_ns(GRANT_BYTES[grants[index]]) + self._timing.guard_ns
        return tuple(grants)

    def _begin_session(self) -> None:
        self.session = self._random_bits(NONCE_BITS)
        self.counter = -1
        self._frame = _no_frame(self._frame.start_ns)
        for peer in self._peers.values():
            peer.forget_session()


def _no_frame(start_ns: int) -> _Frame:
    """Return what stands for the frame before the first one."""
    no_beacon = Beacon(frame=0, sent=0, cumulative=0, order=SlotOrder(), stations=())
    return _Frame(-1, start_ns - IDLE_FRAME_NS, (), SlotOrder(), no_beacon)
