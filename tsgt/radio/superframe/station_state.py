"""One station of the superframe as the master knows it: who it is, what has come from it, what it will want. Pure.

What the master makes of replies that come late: somebody holds back the beacons that they answer.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.commands import MeasureOrder, SearchOrder
from tsgt.radio.superframe.grants import MOST_MEASUREMENTS, UNKNOWN_GRANT, Demand, expected, grant
from tsgt.radio.superframe.receive_window import Inbox
from tsgt.radio.superframe.reception import Heard, TimedSighting
from tsgt.radio.superframe.reply_builder import NARROW_AGE_NS
from tsgt.radio.superframe.wire import (
    SINGLE_QUALITY,
    TIME_BITS,
    TIME_UNIT_US,
    WIDE_TIME_BITS,
    Confirmation,
    angle_rad,
    distance_m,
    order_part,
    quality_bound_us,
)
from tsgt.timesync import Beat, Rhythm

if TYPE_CHECKING:
    from tsgt.radio.commands import Order
    from tsgt.radio.superframe.wire import AnswerPart, OrderPart, Reply, Run, ShotPart, StatePart
    from tsgt.timesync import RoundTrip

UNNOTICED_NS = 30_000_000
"""A beacon that was held back for longer may agree with others, as far as the low bits of their times tell."""


class HeldBack:
    """Whether beacons are held back from a station for longer than it can notice by the low bits of their times.

    Its replies come late by as much. As long as beacons say their times in full, the first one that comes when it should
    contradicts those that did not: with the next one the station knows.

    Attributes
    ----------
    by_ns
        By how much, at most, since it began; 0 from the second reply in a row on that is on time, if the station has been
        told when the beacon of the first one left.
    """

    def __init__(self) -> None:
        self.by_ns = 0
        self._on_time: int | None = None

    def add(self, counter: int, late_ns: int, *, told: bool) -> None:
        """Take by how much the reply to a frame was late.

        Parameters
        ----------
        counter
            Number of the frame.
        late_ns
            By how much, at most.
        told
            The next beacon says when this one left; else the station cannot compare it with others.
        """
        if late_ns > UNNOTICED_NS:
            self.by_ns, self._on_time = max(self.by_ns, late_ns), None
            return
        if self._on_time == counter - 1:
            self.by_ns = 0
        self._on_time = counter if told else None


EXACT_SIGMA_NS = 100_000
"""Kernel stamps are tens of times better; one that is worse was found without its edge, or without kernel stamps."""

SIGMAS = 4
"""A stamp is within so many sigma of the truth."""

FIRST_EXCHANGES = 8
EXCHANGE_EVERY = 32
"""How often the link constant is measured: so often at the start, then in one of so many replies."""

EXCHANGE_STEP = 5
"""From the frame of one station's to that of the next one's: long replies are not to follow each other closely."""

TIME_AT_START = 3
"""In so many frames a station that has introduced itself is told the time in full: it needs two that agree."""

MISSING_EVERY = 32
"""How often a station is asked again, in frames, for measurements that it did not send though it could have."""

USUAL_BEAT = Beat(period_us=400_000, phase_us=0, spread_us=50_000)
"""Of an instrument that tracks; each soon shows its own."""

ANY_RUN_BYTES = 21
"""A measurement in a run of its own takes no more, however old it is."""

LATEST_US = 20_000
"""Nothing is measured later than this after its reply should have begun, or has."""

AGES_KEPT = 32
"""Of so many replies it is looked at how old their newest measurement was."""

HISTORY = 4
"""Of so many frames a beacon says whether a reply is written."""

_ROUNDING_NS = 9_000
"""Half a unit of time, and what rounding to microseconds adds."""


class Reception(NamedTuple):
    """A reply among the instants of its frame.

    Attributes
    ----------
    counter
        Of the frame.
    sent_ns, sent_sigma_ns
        TxDone of the beacon on the master's CLOCK_MONOTONIC.
    slot_ns
        When the station's slot began.
    received_ns, received_sigma_ns
        RxDone of the reply.
    lateness_ns
        By how much that is later than foreseen.
    payload_bytes, granted_bytes
        How long it is, and how long it may have been.
    """

    counter: int
    sent_ns: int
    sent_sigma_ns: int
    slot_ns: int
    received_ns: int
    received_sigma_ns: int
    lateness_ns: int
    payload_bytes: int
    granted_bytes: int


@dataclass(slots=True)
class _Pending:
    """An order that is not answered yet."""

    ticket: int
    order: Order


class Peer:
    """What the master knows of one station.

    Parameters
    ----------
    number, prism
        Of the station, and of the prism that it tracks unless it says otherwise.
    trip
        For the constant of its link.
    zero_ns
        Zero of the session time on the master's CLOCK_MONOTONIC.
    pace
        From one of its first self-calibrations to the next, in frames.

    Attributes
    ----------
    nonce
        Of its introduction to this session; None: it has not joined.
    introducing
        Its last reply still held its introduction.
    lacks_time
        It tells what it measures by how long before or after the frame's beacon it was, and not in session time.
    silent
        For how many frames in which it had a slot it has not been heard.
    late, doubted
        How many slots it had to leave empty, and how many beacons it doubted, since it was first heard.
    """

    def __init__(self, number: int, prism: int, trip: RoundTrip, zero_ns: int, pace: int) -> None:
        self.number = number
        self.inbox = Inbox()
        self.nonce: int | None = None
        self.introducing = False
        self.lacks_time = False
        self.silent = 0
        self.late = 0
        self.doubted = 0
        self._prism = prism
        self._trip = trip
        self._zero_ns = zero_ns
        self._pace = pace
        self._confirm: int | None = None
        self._introduced_at = 0
        self._held_back = HeldBack()
        self._state: StatePart | None = None
        self._ticket = 0
        self._pending: _Pending | None = None
        self._replies: dict[int, tuple[int, ...]] = {}
        self._exchange: tuple[int, int] | None = None
        self._rhythm = Rhythm()
        self._heard_us: int | None = None
        self._newest_ages_us: deque[int] = deque(maxlen=AGES_KEPT)
        self._withheld = 0
        self._repeats = False
        self._plain = False

    def forget_session(self) -> None:
        """Begin a new session; what has been received and written stands."""
        self.nonce, self._confirm, self._state, self._exchange = None, None, None, None
        self._replies.clear()

    # --- Orders -------------------------------------------------------------------------------------------------

    def order(self, order: Order) -> int:
        """Take an order in the place of one that is not answered yet; return its ticket."""
        self._ticket = (self._ticket + 1) % 16
        self._pending = _Pending(self._ticket, order)
        return self._ticket

    def withdraw(self, kind: type[Order]) -> None:
        """Say an order of this kind no more, answered or not; if it is carried out all the same, nobody is told."""
        if self._pending is not None and isinstance(self._pending.order, kind):
            self._pending = None

    def is_tracking(self, prism: int) -> bool:
        """Tell whether it is there, has said that its instrument tracks this prism, and has nothing else to do."""
        state, pending = self._state, self._pending
        return (
            state is not None
            and (state.prism, state.direct, state.connected) == (prism, False, True)
            and self.silent < HISTORY
            and not self.introducing
            and (pending is None or isinstance(pending.order, SearchOrder))
        )

    @property
    def order_part(self) -> OrderPart | None:
        """The order as a beacon says it; None where there is none, or nobody who would obey."""
        if self._pending is None or self.nonce is None or self.introducing:
            return None
        tracked = self._prism if self._state is None else self._state.prism
        return order_part(self.number, self._pending.ticket, self._pending.order, tracked)

    # --- For the next beacon --------------------------------------------------------------------------------------

    @property
    def confirmation(self) -> Confirmation | None:
        """What the next beacon says to a station that has introduced itself."""
        return None if self._confirm is None else Confirmation(self.number, self._confirm)

    def wants_time(self, counter: int) -> bool:
        """Tell whether this beacon has to say the time in full: it has just joined, or its beacons came late."""
        joins = self.nonce is not None and counter - self._introduced_at <= TIME_AT_START
        return joins or self._held_back.by_ns > 0

    def confirmed(self) -> None:
        """Take note that the confirmation has gone out."""
        self._confirm = None

    def history(self, counter: int) -> int:
        """Return which replies of the frames before this one are in the recording; see ``StationEntry``."""
        bits = 0
        for bit in range(HISTORY):
            numbers = self._replies.get(counter - 1 - bit)
            if numbers is not None and self.inbox.is_written(numbers):
                bits |= 1 << bit
        return bits

    def grant(self, counter: int, slot_ns: int, *, cap: int) -> int:
        """Return the grant for a frame in which its slot begins at about this instant; ``cap`` at most."""
        newest_us = self._rhythm.newest_us
        if self.introducing or self.nonce is None or newest_us is None or self._heard_us is None:
            return UNKNOWN_GRANT
        new = expected(
            self._rhythm.beat or USUAL_BEAT,
            newest_us=newest_us,
            heard_us=self._heard_us,
            slot_us=self._session_us(slot_ns),
            ready_us=self._ready_us(),
        )
        withheld = 0 if counter % MISSING_EVERY == self.number else self._withheld
        missing = max(self.inbox.missing - withheld, 0)
        calibrates = (
            (counter - self.number) % self._pace == 0
            if self._trip.exchanges < FIRST_EXCHANGES
            else (counter - EXCHANGE_STEP * self.number) % EXCHANGE_EVERY == 0
        )
        # What was received before all that a beacon tells may come again: the acknowledgement may have been missed.
        unknown = len(self._replies[max(self._replies)]) if self.silent >= HISTORY and self._replies else 0
        repeated = MOST_MEASUREMENTS if self._repeats else 0
        demand = Demand(
            measurements=new + missing + self.inbox.unwritten + unknown + repeated,
            scattered=missing > 0,
            plain=self._plain,
            extended=calibrates,
            answer=self._pending is not None,
            shot=self._pending is not None and isinstance(self._pending.order, MeasureOrder),
        )
        return grant(demand, cap=cap, silent=self.silent)

    # --- Replies --------------------------------------------------------------------------------------------------

    def first_number(self, reply: Reply) -> int:
        """Return the full number of the first measurement of a reply; 0 where there is none."""
        return self._newest(reply.runs[0], reply) if reply.runs else 0

    def may_be_older(self, reply: Reply, at: Reception) -> bool:
        """Tell whether a reply has come so late that a time in it may be 2.1 s older than it looks.

        A station tells by the start of its slot whether a measurement is too old for a narrow run. What leaves much later,
        because its computer stood still or somebody held it back, may have grown too old meanwhile; or it has been made
        meanwhile. Nobody can tell, and it will be sent again.
        """
        oldest_us = self._session_us(at.slot_ns) - NARROW_AGE_NS // 1000 - LATEST_US
        return any(self._newest_us(run, at) - _span_us(run) >= oldest_us for run in reply.runs)

    def take(self, reply: Reply, at: Reception) -> Heard:
        """Take a reply that is known to be this station's.

        Parameters
        ----------
        reply
            What it says.
        at
            When it came.
        """
        joined = self._introduced(reply)
        if reply.introduction is not None:
            self._introduced_at = at.counter
        if reply.runs:
            self.lacks_time = reply.runs[0].direct
        late_ns = self._late_ns(at) + SIGMAS * at.sent_sigma_ns
        self._held_back.add(at.counter, late_ns, told=at.sent_sigma_ns <= EXACT_SIGMA_NS)
        prism = self._prism_of(reply)
        missing = self.inbox.missing
        numbers: list[int] = []
        sightings: list[TimedSighting] = []
        for run in reply.runs:
            found = self._timed(run, self._newest(run, reply), run.prism or prism, at)
            numbers += [sighting.sequence for sighting in found]
            sightings += [sighting for sighting in found if self.inbox.take(sighting.sequence)]
        sightings.sort(key=lambda sighting: sighting.sequence)
        self._replies[at.counter] = tuple(numbers)
        for counter in [counter for counter in self._replies if counter < at.counter - HISTORY]:
            del self._replies[counter]
        for sighting in sightings:
            self._rhythm.add(self._session_us(sighting.measured_ns))
        self._heard_us = self._session_us(at.slot_ns)
        if sightings:
            newest_ns = max(sighting.measured_ns for sighting in sightings)
            self._newest_ages_us.append((at.slot_ns - newest_ns) // 1000)
        self.silent = 0
        # One that sends nothing may have had no room: a measurement that is worse than most takes more.
        self._plain = bool(reply.runs) and _is_plain(reply.runs[0])
        has_room = at.granted_bytes - at.payload_bytes >= ANY_RUN_BYTES
        self._repeats = self._repeats and not has_room
        if self.inbox.missing < missing:
            self._withheld = 0  # it sends what was missing; the next may have needed a run of its own
        elif has_room:
            self._withheld = self.inbox.missing  # there was room for any of them
        self._withheld = min(self._withheld, self.inbox.missing)
        order, answer, shot = self._answered(reply)
        return Heard(
            station=self.number,
            sightings=tuple(sightings),
            repeated=len(numbers) - len(sightings),
            joined=joined,
            state=reply.state,
            doubted_beacons=self._stated(reply.state),
            link_delay_anomaly=not self._exchanged(reply, at),
            lateness_ns=at.lateness_ns,
            order=order,
            answer=answer,
            shot=shot,
        )

    def _ready_us(self) -> int:
        """How old a measurement has to be to be in a reply: as the youngest of late was.

        Room for one that is made in time but not read yet would make every frame longer, and with frames as long as the
        beat that leaves none to move it to where the measurement is in time.
        """
        return min(self._newest_ages_us, default=0)

    def _introduced(self, reply: Reply) -> bool:
        introduction = reply.introduction
        self.introducing = introduction is not None
        if introduction is None:
            return False
        joined = introduction.nonce != self.nonce
        if joined:
            self._state, self._exchange = None, None
            self._replies.clear()
        self.nonce = self._confirm = introduction.nonce
        # It cannot know what has come of that which an earlier run has left, and sends all of it again.
        self._repeats = introduction.oldest < introduction.run_start
        self.inbox.introduced(introduction)
        return joined

    def _prism_of(self, reply: Reply) -> int:
        """Return what is tracked where a run does not say: what the station told before, or tells for the first time."""
        state = self._state or reply.state
        return self._prism if state is None else state.prism

    def _stated(self, state: StatePart | None) -> int:
        """Take note of how the station does; return how many more beacons it doubted."""
        doubted = 0
        if state is not None:
            if self._state is not None:
                self.late += (state.late - self._state.late) % 256
                doubted = (state.doubted - self._state.doubted) % 16
                self.doubted += doubted
            self._state = state
        return doubted

    def _exchanged(self, reply: Reply, at: Reception) -> bool:
        """Measure the link constant where reply and frame before it allow; return whether it is possible."""
        before, self._exchange = self._exchange, None
        possible = True
        if before is not None and before[0] == at.counter - 1 and reply.turn_round_us is not None:
            possible = self._trip.add(before[1] - 1000 * reply.turn_round_us)
        if max(at.sent_sigma_ns, at.received_sigma_ns) <= EXACT_SIGMA_NS:
            self._exchange = (at.counter, at.received_ns - at.sent_ns)
        return possible

    def _answered(self, reply: Reply) -> tuple[Order | None, AnswerPart | None, ShotPart | None]:
        """Return the order that has waited for this reply, and waits no more, with what the reply says to it."""
        pending = self._pending
        if pending is None:
            return None, None, None
        answer = reply.answer if reply.answer is not None and reply.answer.ticket == pending.ticket else None
        shot = reply.shot if reply.shot is not None and reply.shot.ticket == pending.ticket else None
        if answer is None and shot is None:
            return None, None, None
        self._pending = None
        return pending.order, answer, shot

    # --- Numbers and times ------------------------------------------------------------------------------------------

    def _newest(self, run: Run, reply: Reply) -> int:
        number = run.sightings[0].sequence
        return number if run.wide else self.inbox.unwrapped(number, reply.introduction)

    def _timed(self, run: Run, newest_number: int, prism: int, at: Reception) -> list[TimedSighting]:
        newest = run.sightings[0]
        newest_us = self._newest_us(run, at)
        claimed_ns = 1000 * quality_bound_us(run.quality)
        if run.direct:  # a beacon that somebody held back makes its reply late by as much
            claimed_ns += self._late_ns(at) + SIGMAS * at.sent_sigma_ns
        else:
            claimed_ns += self._held_back.by_ns
        sigma_ns = math.hypot(claimed_ns / SIGMAS, _ROUNDING_NS / math.sqrt(3), self._trip.sigma_ns)
        bound_ns = claimed_ns + _ROUNDING_NS + self._trip.bound_ns + self._trip.delay_ns
        timed = []
        for sighting in run.sightings:
            back = sighting is not newest
            number = newest_number + (sighting.sequence - newest.sequence if back else 0)
            time_us = newest_us + (TIME_UNIT_US * (sighting.time - newest.time) if back else 0)
            if number < 0:
                continue
            timed.append(
                TimedSighting(
                    sequence=number,
                    prism=prism,
                    measured_ns=self._zero_ns + 1000 * time_us + self._trip.link_ns,
                    sigma_ns=round(sigma_ns),
                    bound_ns=bound_ns,
                    status=sighting.status,
                    horizontal_angle_rad=angle_rad(sighting.horizontal),
                    zenith_angle_rad=angle_rad(sighting.zenith),
                    slope_distance_m=distance_m(sighting.distance, far=run.far),
                )
            )
        return timed

    def _late_ns(self, at: Reception) -> int:
        """Return by how much more than usual a reply may have been late; the master may not have seen its end."""
        usual_ns = 2 * (self._trip.link_ns - self._trip.nominal_ns)
        return max(_latest_ns(at) - usual_ns, 0)

    def _newest_us(self, run: Run, at: Reception) -> int:
        """Return the newest time of a run; narrow ones repeat, and it is the last before the reply has begun."""
        end_us = self._session_us(at.slot_ns + max(_latest_ns(at), 0)) + LATEST_US
        origin_us = self._session_us(at.sent_ns) if run.direct else 0
        return end_us - (end_us - origin_us - TIME_UNIT_US * run.sightings[0].time) % _span_us(run)

    def _session_us(self, monotonic_ns: int) -> int:
        return (monotonic_ns - self._zero_ns + 500) // 1000


def _latest_ns(at: Reception) -> int:
    return at.lateness_ns + SIGMAS * at.received_sigma_ns


def _span_us(run: Run) -> int:
    """Return after how long a run's times repeat."""
    return TIME_UNIT_US << (WIDE_TIME_BITS if run.wide else TIME_BITS)


def _is_plain(run: Run) -> bool:
    return run.quality <= SINGLE_QUALITY and run.prism is None and not (run.direct or run.wide or run.far)
