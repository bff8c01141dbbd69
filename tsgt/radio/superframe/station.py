"""The station's side of the superframe: packets, their instants and measurements in, replies and orders out.

A station answers whoever can prove to have the key. Proof that it is not a recording of yesterday takes one exchange:
the station introduces itself with a number of its own, and a beacon with this number confirms it. Until then it sends
what it measures, for nobody gains by that, but takes nothing for delivered, obeys no order and keeps no time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import MessageError
from tsgt.radio.superframe.reply_builder import LEAST_SIGHTING_BYTES, pack
from tsgt.radio.superframe.session import SessionKeeper
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    AnswerPart,
    Introduction,
    Reply,
    ShotPart,
    StatePart,
    decode_beacon,
    distance_code,
    encode_reply,
    reply_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tsgt.model import Status
    from tsgt.radio.base import LoRaSettings, Packet, Transmitted
    from tsgt.radio.commands import Order
    from tsgt.radio.superframe.command_exchange import Conversation, Situation
    from tsgt.radio.superframe.reply_builder import Timed
    from tsgt.radio.superframe.send_queue import Outbox
    from tsgt.radio.superframe.session import Reception, StationSession
    from tsgt.radio.superframe.slots import SlotSpan
    from tsgt.radio.superframe.wire import Authenticator

WORST_STAMP_NS = 1_000_000
"""A beacon whose stamp has a larger sigma tells no slot."""

EXACT_SIGMA_NS = 100_000
"""A stamp with a larger sigma was found without its edge, and measures nothing."""

PREPARATION_NS = 1_000_000
"""What a radio needs to start a transmission that is late already."""

FEW = 8
"""With more than so many measurements the older ones are a backlog."""
LONGEST_WAIT = 2
"""When the oldest of few did not fit in so many replies in a row, it goes first for once."""


@dataclass(frozen=True, slots=True)
class Heard:
    """What an authentic beacon has brought.

    Attributes
    ----------
    slot_ns
        When the station's slot begins, on its CLOCK_MONOTONIC; None without a slot.
    reception
        Of the beacon before it, for the journal.
    doubted
        The beacon before it came at a time that cannot be.
    joined
        This beacon has confirmed the station.
    left_behind
        How many measurements have left the queue because nobody can put them on this master's clock.
    """

    slot_ns: int | None
    reception: Reception | None
    doubted: bool
    joined: bool
    left_behind: int


class _Slot(NamedTuple):
    span: SlotSpan
    end_ns: int  # of the beacon on the air
    start_ns: int


class SuperframeStation:
    """What a station answers.

    Parameters
    ----------
    station
        Its number, 1 to 16.
    settings
        Of the modem.
    authenticator
        Has the key.
    outbox
        What is to be delivered; measurements are added to it as soon as they are journalled.
    lineage
        16 bits: the same as long as sequence numbers go on.
    boot
        Since which start of this computer its clock has run like this.
    receptions
        What earlier runs of the program have journalled, in the order in which they were made.
    random_bits
        Returns a number with so many random bits.

    Attributes
    ----------
    late
        How many slots were left empty because the computer was late, or overrun.
    doubted
        How many beacons came at a time that cannot be.
    heard_ns, rssi_dbm, snr_db
        RxDone and strength of the latest authentic beacon; None before the first.
    """

    def __init__(
        self,
        station: int,
        settings: LoRaSettings,
        authenticator: Authenticator,
        outbox: Outbox,
        *,
        lineage: int,
        boot: str,
        receptions: Iterable[Reception] = (),
        random_bits: Callable[[int], int],
    ) -> None:
        self._station = station
        self._authenticator = authenticator
        self._outbox = outbox
        self._lineage = lineage
        self._sessions = SessionKeeper(
            station, settings, authenticator, outbox, boot, receptions, random_bits
        )
        self._slot: _Slot | None = None
        self._latest_ns = 0
        self._passed_over = 0
        self._under_way: tuple[Conversation, int] | None = None
        self.late = self.doubted = 0
        self.heard_ns: int | None = None
        self.rssi_dbm: float | None = None
        self.snr_db: float | None = None

    @property
    def refused(self) -> int:
        """How many packets looked like a beacon with a session and had a wrong code."""
        return self._sessions.refused

    @property
    def joined(self) -> bool:
        """Whether a master has confirmed the station, and no other is tried."""
        session = self._sessions.current
        return session is not None and session.confirmed

    def clock_bound_us(self, now_ns: int) -> float | None:
        """Return how well the master's time is known; None where it is not."""
        session = self._sessions.current
        time = None if session is None else session.clock.at(now_ns)
        return None if time is None else time.bound_us

    # --- Beacons ----------------------------------------------------------------------------------------------

    def received(self, packet: Packet) -> Heard | None:
        """Take a packet, whatever it is; return what it brings if it is a beacon for this station."""
        try:
            beacon = decode_beacon(packet.payload[:-CODE_BYTES])
        except MessageError:
            return None
        session = self._sessions.find(beacon, packet)
        if session is None:
            return None
        self.heard_ns, self.rssi_dbm, self.snr_db = packet.received_at_ns, packet.rssi_dbm, packet.snr_db
        joined = self._sessions.confirm(session)
        left_behind = self._outbox.keep(session.can_time) if joined else 0
        reception = session.reception()
        mine = self._station - 1
        doubted = reception is not None and not session.clock.add(
            reception.received_ns,
            reception.sent_us,
            reception.sigma_ns,
            in_full=beacon.session is not None,
            live=mine < len(beacon.stations) and bool(beacon.stations[mine].history & 1),
        )
        if doubted:
            self.doubted += 1
            session.conversation.doubt()
        if session.confirmed and mine < len(beacon.stations):
            session.acknowledge(beacon.stations[mine].history)
            if session.heard.counter % len(beacon.stations) == mine:
                session.delivery.delivered_through(beacon.cumulative)
            session.conversation.take(order for order in beacon.orders if order.station == self._station)
        left_behind += session.sift()
        self._slot = self._slot_of(session)
        return Heard(
            slot_ns=None if self._slot is None else self._slot.start_ns,
            reception=None if doubted else reception,
            doubted=doubted,
            joined=joined,
            left_behind=left_behind,
        )

    def _slot_of(self, session: StationSession) -> _Slot | None:
        heard = session.heard
        entries = heard.beacon.stations
        if self._station > len(entries) or heard.sigma_ns > WORST_STAMP_NS:
            return None
        grants = [entry.grant for entry in entries]
        span = session.timing.slots(grants, heard.beacon.order)[self._station - 1]
        if span is None:
            return None
        end_ns = heard.received_ns - session.timing.reception_ns
        return _Slot(span, end_ns, end_ns + span.start_ns)

    # --- Orders -----------------------------------------------------------------------------------------------

    def next_order(self) -> Order | None:
        """Return the next order, to be carried out and then reported; None while another one is under way."""
        session = self._sessions.confirmed
        following = None if self._under_way or session is None else session.conversation.next_order()
        if following is None or session is None:
            return None
        ticket, order = following
        self._under_way = session.conversation, ticket
        return order

    def executed(self, *, ok: bool) -> None:
        """Report what became of the order under way; of a single measurement only that it failed."""
        conversation, ticket = self._finish()
        conversation.answers.append(AnswerPart(ticket, ok))

    def shot(self, status: Status, horizontal: int, zenith: int, distance_m: float | None) -> None:
        """Report the single measurement under way; angles as they go over the air."""
        conversation, ticket = self._finish()
        distance = distance_code(distance_m, far=False)
        conversation.shots.append(ShotPart(ticket, status, horizontal, zenith, distance))

    def _finish(self) -> tuple[Conversation, int]:
        if self._under_way is None:
            raise RuntimeError("nothing can be reported of an order when none is under way")
        under_way, self._under_way = self._under_way, None
        return under_way

    # --- Reply ------------------------------------------------------------------------------------------------

    def compose(self, situation: Situation, now_ns: int) -> bytes | None:
        """Return the reply for the slot; None where there is no slot, it is too late for it, or it is too small.

        Called as shortly before the slot as can be, and once.

        Parameters
        ----------
        situation
            What the instrument is doing.
        now_ns
            CLOCK_MONOTONIC.
        """
        session, slot, self._slot = self._sessions.current, self._slot, None
        if session is None or slot is None:
            return None
        reply, sequences = self._fill(session, situation, slot)
        if not session.confirmed and reply.introduction is None:
            return None  # nobody would know whose it is; a master grants more to those that it does not know
        content = encode_reply(reply)
        latest_ns = slot.end_ns + session.timing.latest_start_ns(slot.span, len(content) + CODE_BYTES)
        if now_ns + PREPARATION_NS > latest_ns:
            self.late += 1
            return None
        self._latest_ns = latest_ns
        session.replied(reply, sequences)
        return content + self._authenticator.reply_code(
            session=session.master_nonce,
            station=self._station,
            station_nonce=session.nonce,
            counter=session.heard.counter,
            beacon_code=session.heard.code,
            sequence=sequences[0] if sequences else 0,
            content=content,
        )

    def sent(self, transmitted: Transmitted) -> None:
        """Take note that the reply that was composed last is out."""
        self.late += transmitted.started_at_ns > self._latest_ns
        session = self._sessions.current
        if (
            session is not None
            and session.last_reply is not None
            and transmitted.stamp_sigma_ns <= EXACT_SIGMA_NS
        ):
            session.last_reply.done_ns = transmitted.done_at_ns

    def _fill(
        self, session: StationSession, situation: Situation, slot: _Slot
    ) -> tuple[Reply, tuple[int, ...]]:
        """Choose what to say: what is owed, measurements, and where there is room other news."""
        limit_bytes = slot.span.reply_bytes
        conversation = session.conversation
        parts = self._owed(session, situation, limit_bytes)
        urgent = self._by_urgency(session, slot.start_ns, limit_bytes // LEAST_SIGHTING_BYTES)
        prism = conversation.plain_prism(parts.state or self._state(situation))
        narrow = session.delivery.may_be_narrow
        reply, taken = pack(parts, urgent, limit_bytes, prism=prism, is_narrow=narrow)
        turn_round_us = session.turn_round_us()
        if turn_round_us is not None:
            news = replace(parts, state=self._state(situation), turn_round_us=turn_round_us)
            longer, still = pack(news, urgent, limit_bytes, prism=prism, is_narrow=narrow)
            fits = reply_bytes(longer) <= limit_bytes
            if fits and (len(still) == len(taken) or conversation.turn_round_is_overdue):
                reply, taken = longer, still
        sequences = tuple(timed.queued.sequence for timed in taken)
        oldest = min((timed.queued.sequence for timed in urgent), default=None)
        self._passed_over = 0 if oldest is None or oldest in sequences else self._passed_over + 1
        return reply, sequences

    def _owed(self, session: StationSession, situation: Situation, limit_bytes: int) -> Reply:
        """Return what the master has to be told before anything else, as far as it fits."""
        conversation, delivery = session.conversation, session.delivery
        if delivery.outdated and not delivery.introducing:
            delivery.introduce()
        owed = []
        if not session.confirmed or delivery.introducing:
            owed.append(Reply(introduction=self._introduction(session)))
        # The newest: a master waits for no more than that one.
        owed += [Reply(answer=answer) for answer in list(conversation.answers)[-1:]]
        owed += [Reply(shot=shot) for shot in list(conversation.shots)[-1:]]
        if conversation.must_tell(situation):
            owed.append(Reply(state=self._state(situation)))
        reply = Reply()
        for part in owed:
            longer = Reply(
                introduction=reply.introduction or part.introduction,
                answer=reply.answer or part.answer,
                shot=reply.shot or part.shot,
                state=reply.state or part.state,
            )
            if reply_bytes(longer) <= limit_bytes:
                reply = longer
        return reply

    def _introduction(self, session: StationSession) -> Introduction:
        return Introduction(
            nonce=session.nonce,
            lineage=self._lineage,
            run_start=self._outbox.run_start,
            oldest=session.delivery.oldest,
        )

    def _state(self, situation: Situation) -> StatePart:
        return StatePart(
            prism=situation.prism,
            direct=situation.direct,
            connected=situation.connected,
            late=self.late % 256,
            doubted=self.doubted % 16,
            rssi_dbm=min(max(round(self.rssi_dbm or 0), -127), 0),
        )

    def _by_urgency(self, session: StationSession, slot_ns: int, most: int) -> list[Timed]:
        """Return measurements that this master can be told of, the one that is wanted most first.

        That is the newest, because a robot drives by it. After it come, if there are few, those that have waited
        longest, so that none waits long; after an outage the next newer ones, so that what is lost on the way of
        those does not grow old as well. An old one that needs a run of its own may never fit behind the newest, and
        goes first then, for once.
        """
        newest = islice(filter(session.can_time, self._outbox.newest_first()), most)
        urgent: list[Timed] = []
        for queued in newest:
            timed = session.timed(queued, slot_ns, urgent[0] if urgent else None)
            if timed is not None:
                urgent.append(timed)
        if 1 < len(self._outbox) <= FEW:
            urgent[1:] = urgent[:0:-1]
            if self._passed_over >= LONGEST_WAIT:
                urgent[:2] = urgent[1::-1]
        return urgent
