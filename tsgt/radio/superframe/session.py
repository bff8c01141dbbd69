"""What a station knows of one session of a master: its frames, its time, and what it has of this station.

Which session of a master a station is in, and whether a beacon belongs to it.
"""

from __future__ import annotations

import hmac
from collections import deque
from dataclasses import dataclass
from itertools import takewhile
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.command_exchange import Conversation
from tsgt.radio.superframe.reply_builder import Timed, quality_of
from tsgt.radio.superframe.send_queue import Delivery
from tsgt.radio.superframe.slots import GUARD_UNIT_NS, FrameTiming
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    SESSION_TIME_BITS,
    TIME_UNIT_US,
    TURN_ROUND_BITS,
    Confirmation,
)
from tsgt.timesync import BeaconClock

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from tsgt.radio.base import LoRaSettings, Packet
    from tsgt.radio.superframe.send_queue import Outbox, Queued
    from tsgt.radio.superframe.wire import Authenticator, Beacon, Reply, SessionPart

HISTORY = 4
"""A beacon tells of so many frames before it whether the reply is in the recording."""

FRAME_BITS = 8
_SENT_BITS = 16

_DIRECT_EXTRA_US = 2000.0
"""A time that rests on one beacon is worse than it looks, by as much as the reply may start late."""

_REACH_NS = int(4.4 * 3600e9)
"""What was measured longer before the first beacon gets no time to half a second, however well they tell the rate."""

_TOLD_NS = 60_000_000_000
"""Beacons that come later than this after an instant tell no more of its time."""

_SIGMAS = 4
"""A bound is so many sigma."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reception:
    """When a beacon left, by the master's clock, and when it came, by the station's.

    Attributes
    ----------
    session
        The master's nonce.
    counter
        Number of the frame in the session.
    received_ns
        RxDone on CLOCK_MONOTONIC of the station's computer.
    sigma_ns
        One sigma of that.
    sent_us
        TxDone in session time.
    boot
        Since which start of the station's computer its clock has run like this.
    """

    session: int
    counter: int
    received_ns: int
    sigma_ns: int
    sent_us: int
    boot: str


class HeardBeacon(NamedTuple):
    """A beacon that has been found authentic; times on CLOCK_MONOTONIC."""

    beacon: Beacon
    code: bytes
    counter: int
    received_ns: int
    sigma_ns: int


@dataclass(slots=True)
class SentReply:
    """A reply that is on the air, or was.

    Attributes
    ----------
    heard
        The beacon that it answers.
    reply
        What it says.
    sequences
        The measurements in it.
    done_ns
        TxDone on CLOCK_MONOTONIC; None while it is not known to better than a millisecond.
    """

    heard: HeardBeacon
    reply: Reply
    sequences: tuple[int, ...]
    done_ns: int | None = None


class StationSession:
    """One session of a master.

    Parameters
    ----------
    heard
        A beacon with a session part.
    part
        That part.
    nonce
        The station's own nonce for this session, 32 bits.
    settings
        Of the modem.
    outbox
        What is to be delivered.
    boot
        Since which start of this computer its clock has run like this.
    clocks
        What earlier runs of the program knew of this master's time, by the start of this computer.

    Attributes
    ----------
    master_nonce, nonce
        The master's and the station's.
    confirmed
        The master has proved that it has heard this station in this session; it is no recording.
    heard
        The newest beacon.
    timing
        Of the frames.
    clock
        The master's time on this computer's clock.
    delivery
        What the master has.
    conversation
        What else there is to say.
    last_reply
        The latest reply; None before the first.
    """

    def __init__(
        self,
        heard: HeardBeacon,
        part: SessionPart,
        nonce: int,
        settings: LoRaSettings,
        outbox: Outbox,
        boot: str,
        clocks: Mapping[str, BeaconClock],
    ) -> None:
        self.master_nonce = part.nonce
        self.nonce = nonce
        self.confirmed = False
        self.heard = heard
        self._before: HeardBeacon | None = None
        self.timing = _timing(settings, part)
        self._boot = boot
        self._outbox = outbox
        self._clocks = dict(clocks)
        self.clock = self._clocks.setdefault(boot, BeaconClock())
        self.delivery = Delivery(outbox, self.can_time)
        self.conversation = Conversation()
        self.last_reply: SentReply | None = None
        self._unanswered: deque[SentReply] = deque(maxlen=HISTORY)
        self._sifted = False

    # --- Beacons ----------------------------------------------------------------------------------------------

    def counter_of(self, beacon: Beacon) -> int | None:
        """Return the number of the frame, if the beacon is of this session; None for one that is not, or is not new."""
        if beacon.session is None:
            following = self.heard.counter + 1
            return following + (beacon.frame - following) % (1 << FRAME_BITS)
        counter = full_counter(beacon.session, beacon)
        of_this = beacon.session.nonce == self.master_nonce
        return counter if of_this and counter > self.heard.counter else None

    def listen(self, heard: HeardBeacon) -> None:
        """Take the next authentic beacon."""
        self._before, self.heard = self.heard, heard
        if heard.beacon.session is not None:
            self.timing = _timing(self.timing.settings, heard.beacon.session)

    def reception(self) -> Reception | None:
        """Return when the beacon before the newest came and had left, if the newest tells.

        None also before the master is confirmed: it may be a recording, whose times would bend the clock.
        """
        before, beacon = self._before, self.heard.beacon
        follows = before is not None and before.counter + 1 == self.heard.counter
        if before is None or not follows or not self.confirmed or not beacon.sent:
            return None
        sent_us = self._unwrap(before.received_ns, beacon)
        if sent_us is None:
            return None
        return Reception(
            session=self.master_nonce,
            counter=before.counter,
            received_ns=before.received_ns,
            sigma_ns=before.sigma_ns,
            sent_us=sent_us,
            boot=self._boot,
        )

    def _unwrap(self, received_ns: int, beacon: Beacon) -> int | None:
        if beacon.session is None:
            return self.clock.unwrap(received_ns, beacon.sent)
        sent_us = beacon.session.sent_high << _SENT_BITS | beacon.sent
        now = self.clock.at(received_ns)
        if now is None:
            return sent_us
        half = 1 << SESSION_TIME_BITS - 1  # in a session of 13 days and more
        return sent_us + (round(now.time_us) - sent_us + half >> SESSION_TIME_BITS << SESSION_TIME_BITS)

    # --- Acknowledgement --------------------------------------------------------------------------------------

    def replied(self, reply: Reply, sequences: tuple[int, ...]) -> None:
        """Take it that the newest beacon is answered like this."""
        self.last_reply = SentReply(self.heard, reply, sequences)
        self._unanswered.append(self.last_reply)
        self.delivery.sent(sequences)
        self.conversation.said(reply, self.heard.counter)

    def acknowledge(self, history: int) -> None:
        """Take which of the latest replies are in the recording, as the newest beacon says."""
        for sent in list(self._unanswered):
            age = self.heard.counter - sent.heard.counter - 1
            if age < HISTORY and history >> age & 1:
                self._unanswered.remove(sent)
                self.delivery.delivered(sent.sequences)
                if sent.reply.introduction is not None:
                    self.delivery.introduced(sent.reply.introduction.oldest)
                self.conversation.acknowledged(sent.reply, sent.heard.counter)

    # --- Time -------------------------------------------------------------------------------------------------

    def can_time(self, queued: Queued) -> bool:
        """Whether this master's time of a measurement can be told, now or soon.

        Not if it is so far from all beacons that no quality is bad enough. Nor if it is of another start of this computer,
        which had not learnt this master's time, or only just: what could have shown that the first beacons were held back
        did not come any more.
        """
        clock = self._clocks.get(queued.boot)
        if clock is None:
            return False
        if queued.boot == self._boot:
            first_ns = clock.first_received_ns
            return first_ns is None or first_ns - queued.at_ns <= _REACH_NS
        time = clock.at(queued.at_ns) if clock.settled else None
        return time is not None and quality_of(time.bound_us) is not None

    def sift(self) -> int:
        """Leave behind what will never have a time, as soon as that is known; return how many measurements that were.

        It would wait for ever, and the master for it. How far back times reach depends on what the first beacons told of
        the rate, which takes a minute to know. The oldest go: the newest are told first, so what can be told behind them is.
        """
        if not self.confirmed or not self.clock.settled:
            return 0
        left = 0 if self._sifted else self._outbox.keep(self.can_time)
        self._sifted = True
        hopeless = [queued.sequence for queued in takewhile(self._is_hopeless, self._outbox.oldest_first())]
        self._outbox.remove(hopeless)
        left += len(hopeless)
        if left:
            self.delivery.introduce()
        return left

    def _is_hopeless(self, queued: Queued) -> bool:
        """Whether nothing useful is known of when a measurement was made, and no beacon will tell."""
        first_ns, last_ns = self.clock.first_received_ns, self.clock.last_received_ns
        if queued.boot != self._boot or first_ns is None or last_ns is None:
            return False
        told = last_ns - max(first_ns, queued.at_ns) > _TOLD_NS
        return told and self.timed(queued, self.heard.received_ns) is None

    def timed(self, queued: Queued, slot_ns: int, newest: Timed | None = None) -> Timed | None:
        """Return a measurement with its time for a slot that begins then; None where nothing useful is known.

        A change between direct times and others costs a run of its own, so it keeps to what ``newest`` in the reply has,
        unless it is better otherwise. As long as held-back beacons would not have been outvoted there are direct times only:
        to those the master adds by how much the reply came late.
        """
        clock = self._clocks[queued.boot]
        live = queued.boot == self._boot
        time = clock.at(queued.at_ns) if clock.settled else None
        direct = False
        extra_us = 0.0 if newest is not None and newest.direct else _DIRECT_EXTRA_US
        if newest is not None and not newest.direct:
            live = live and time is None
        if live and (time is None or time.bound_us > extra_us):
            alone = clock.elapsed(self.heard.received_ns, queued.at_ns)
            stamp_us = _SIGMAS * self.heard.sigma_ns / 1000
            if time is None or alone.bound_us + stamp_us + extra_us < time.bound_us:
                time, direct = alone._replace(bound_us=alone.bound_us + stamp_us), True
        quality = None if time is None else quality_of(time.bound_us)
        if time is None or quality is None:
            return None
        age_ns = slot_ns - queued.at_ns if queued.boot == self._boot else None
        return Timed(queued, round(time.time_us / TIME_UNIT_US), quality, direct, age_ns)

    def turn_round_us(self) -> int | None:
        """Return what the previous reply took from RxDone of its beacon to its TxDone, if it was in the frame before."""
        last = self.last_reply
        if last is None or last.done_ns is None or last.heard.counter + 1 != self.heard.counter:
            return None
        took_us = round(self.clock.elapsed(last.heard.received_ns, last.done_ns).time_us)
        return took_us if took_us < 1 << TURN_ROUND_BITS else None


def _timing(settings: LoRaSettings, part: SessionPart) -> FrameTiming:
    return FrameTiming(settings, part.guard * GUARD_UNIT_NS, part.turn_round * GUARD_UNIT_NS)


def full_counter(part: SessionPart, beacon: Beacon) -> int:
    """Return the number of a beacon's frame in the session that it tells of."""
    return part.counter_high << FRAME_BITS | beacon.frame


PATIENCE_NS = 3_000_000_000
"""Another session is tried only when the confirmed one has been silent for so long."""

_NONCE_BITS = 32


class SessionKeeper:
    """Keeps the session that is confirmed, and beside it one that is tried.

    Whoever has recorded a session can play it back, so that one that is merely authentic is tried only while the
    confirmed one is silent, and forgotten as soon as that is heard again.

    Parameters
    ----------
    station
        Number of the station.
    settings, outbox, boot
        For new sessions; see :class:`~tsgt.radio.superframe.session.StationSession`.
    authenticator
        Has the key.
    receptions
        What earlier runs of the program have journalled, in the order in which they were made.
    random_bits
        Returns a number with so many random bits.

    Attributes
    ----------
    confirmed, candidate
        The two; None where there is none.
    refused
        How many packets looked like a beacon with a session and had a wrong code.
    """

    def __init__(
        self,
        station: int,
        settings: LoRaSettings,
        authenticator: Authenticator,
        outbox: Outbox,
        boot: str,
        receptions: Iterable[Reception],
        random_bits: Callable[[int], int],
    ) -> None:
        self._station = station
        self._settings = settings
        self._authenticator = authenticator
        self._outbox = outbox
        self._boot = boot
        self._random_bits = random_bits
        self._clocks: dict[int, dict[str, BeaconClock]] = {}
        for reception in receptions:
            clock = self._clocks.setdefault(reception.session, {}).setdefault(reception.boot, BeaconClock())
            clock.add(reception.received_ns, reception.sent_us, reception.sigma_ns, in_full=True)
        self.confirmed: StationSession | None = None
        self.candidate: StationSession | None = None
        self.refused = 0

    @property
    def current(self) -> StationSession | None:
        """The session that is answered."""
        return self.candidate or self.confirmed

    def find(self, beacon: Beacon, packet: Packet) -> StationSession | None:
        """Return the session of an authentic beacon, which is its newest from now on; None for any other beacon.

        Parameters
        ----------
        beacon
            What the packet says.
        packet
            As it came.
        """
        for session in (self.confirmed, self.candidate):
            if session is None or (counter := session.counter_of(beacon)) is None:
                continue
            if self._is_authentic(session.master_nonce, counter, packet):
                if session is self.confirmed:
                    self.candidate = None
                session.listen(_heard(beacon, counter, packet))
                return session
        return self._begin(beacon, packet)

    def _begin(self, beacon: Beacon, packet: Packet) -> StationSession | None:
        part = beacon.session
        if part is None or not self._may_try(part.nonce, packet.received_at_ns):
            return None
        counter = full_counter(part, beacon)
        if not self._is_authentic(part.nonce, counter, packet):
            self.refused += 1
            return None
        self.candidate = StationSession(
            _heard(beacon, counter, packet),
            part,
            self._random_bits(_NONCE_BITS),
            self._settings,
            self._outbox,
            self._boot,
            self._clocks.get(part.nonce, {}),
        )
        return self.candidate

    def _is_authentic(self, master_nonce: int, counter: int, packet: Packet) -> bool:
        content, code = packet.payload[:-CODE_BYTES], packet.payload[-CODE_BYTES:]
        right = self._authenticator.beacon_code(session=master_nonce, counter=counter, content=content)
        return hmac.compare_digest(right, code)

    def _may_try(self, master_nonce: int, now_ns: int) -> bool:
        """Whether a beacon of another session is looked at."""
        known = [session for session in (self.confirmed, self.candidate) if session is not None]
        if any(session.master_nonce == master_nonce for session in known):
            return False  # it has been heard before
        return self.confirmed is None or now_ns - self.confirmed.heard.received_ns >= PATIENCE_NS

    def confirm(self, session: StationSession) -> bool:
        """Look whether the newest beacon of a session confirms it for the first time."""
        confirmation = Confirmation(self._station, session.nonce)
        if session.confirmed or confirmation not in session.heard.beacon.confirmations:
            return False
        session.confirmed = True
        self.confirmed, self.candidate = session, None
        self._clocks.clear()  # no other session will need them
        return True


def _heard(beacon: Beacon, counter: int, packet: Packet) -> HeardBeacon:
    return HeardBeacon(
        beacon, packet.payload[-CODE_BYTES:], counter, packet.received_at_ns, packet.stamp_sigma_ns
    )
