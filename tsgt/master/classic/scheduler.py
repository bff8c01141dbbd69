"""Whose turn it is on the classic protocol's one channel, and for what. Pure.

Problem: all stations share the channel, and a station that does not answer takes a whole time-out of the others'
time. Idea: turns go round; in its turn a station gets the one thing that it needs most. A turn that brings nothing
is paid for: the station is left alone for a multiple of the time that it took. So a dead station costs the others
a twentieth of theirs, whatever a turn lasts. The first poll that brings nothing is repeated before anybody else's turn:
most often it is a single packet that was lost.

A station is told to track its prism, then synchronised, then polled. While it is silent after that, polls go on as
the cheapest way to find out that it is back. Polls and measuring on a target begin with the same letter, so
a station that has not said that it tracks is never polled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.radio.classic import CommandMessage, CommandTransaction, Poll, Synchronisation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.radio.classic.transactions import LinkTiming

ORDER_TIMEOUT_NS = 1_000_000_000
"""A station that tracks says so at once. One that has to turn to its prism first takes longer, and is asked again:
waiting for it would keep all others waiting, just as a lost packet would."""

LATEST_ANSWER_NS = 20_000_000_000
"""A station may answer an order this late."""

FIRST_INTERVAL_NS = 30_000_000_000
"""From a station's first synchronisation to its second. Before that, the frequency of its clock is but a guess."""
_INTERVAL_GROWTH = 3

_SPACING_NS = 5_000_000_000
"""Between one synchronisation that can wait and the next, so that the stations' tracks do not break for longer."""

_LARGEST_PAUSE = 20
"""Times that a fruitless turn took: a station that is gone gets a twentieth of the time."""

_ANSWERING_PAUSE = 3
"""A station that answers, but without samples or leaving its clock in doubt, gets up to a third: it may be well again with
the next packet."""

_OUTAGE_SHARE = 4
"""A station that is silent for some time is looked for again within a quarter of that time."""

_STUCK_EVERY = 4
"""Every fourth turn of a silent station is a synchronisation, but not among the first."""

Task = Poll | Synchronisation | CommandTransaction


@dataclass(frozen=True, slots=True, kw_only=True)
class StationPlan:
    """What the scheduler has to know of a station.

    Attributes
    ----------
    station, prism
        Their numbers.
    stamp_delay_ns
        How late its computer stamps the reception of a packet, in ns.
    """

    station: int
    prism: int
    stamp_delay_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Cadence:
    """How often clocks are synchronised.

    Attributes
    ----------
    initial_cycles
        Cycles of a station's first synchronisation, at the start.
    resync_cycles
        Cycles of every other one.
    interval_ns
        From one synchronisation of a station to its next, in ns. Stations are staggered evenly over it.
    first_interval_ns
        From the first to the second; it triples until it has reached ``interval_ns``.
    """

    initial_cycles: int
    resync_cycles: int
    interval_ns: int
    first_interval_ns: int = FIRST_INTERVAL_NS

    def following_ns(self, earlier: int) -> int:
        """Return the time from a synchronisation to the next one, when there were so many ``earlier`` ones; in ns."""
        grown_ns: int = self.first_interval_ns * _INTERVAL_GROWTH**earlier
        return min(grown_ns, self.interval_ns)


class Scheduler:
    """Hands out turns, one at a time.

    Parameters
    ----------
    stations
        In the order of the round.
    cadence
        When to synchronise.
    timing
        How long packets last.
    start_ns
        The present; like all instants here on any one clock in ns.
    """

    def __init__(
        self, stations: Sequence[StationPlan], cadence: Cadence, timing: LinkTiming, start_ns: int
    ) -> None:
        self._round = [_Station(plan) for plan in stations]
        self._cadence = cadence
        self._timing = timing
        self._start_ns = start_ns
        self._slots = {plan.station: number for number, plan in enumerate(stations, start=1)}
        self._began_ns = start_ns
        self._spaced_ns = start_ns

    def next(self, now_ns: int) -> Task | int:
        """Return the turn to take now, or until when every station is to be left alone.

        A turn that was broken off, because the radio failed, need not be told to :meth:`finished`.
        """
        urgent = [s for s in self._round if s.urgent and s.not_before_ns <= now_ns]
        ready = urgent or [s for s in self._round if s.not_before_ns <= now_ns]
        if not ready:
            return min(station.not_before_ns for station in self._round)
        station = ready[0]
        self._round.remove(station)
        self._round.append(station)
        self._began_ns = now_ns
        return self._turn(station, now_ns)

    def finished(self, turn: Task, now_ns: int) -> None:
        """Take note of what came of the turn that :meth:`next` returned last."""
        station = self._station(turn.station)
        took_ns = now_ns - self._began_ns
        if isinstance(turn, CommandTransaction):
            # It does not say whose it is: it may be another's, late. That one is no second time late.
            sure = station.agreed or not any(
                other is not station and now_ns < other.may_answer_ns for other in self._round
            )
            station.silent, station.tracks = turn.ok is None, bool(turn.ok) and sure
            station.agreed = bool(turn.ok)
            if turn.ok is not None:
                station.silent_since_ns = None
            station.may_answer_ns = now_ns + LATEST_ANSWER_NS if turn.ok is None else 0
            # A refusal costs little and a lost packet a lot: the latter is not multiplied by how often it was refused.
            station.refused = 0 if turn.ok else station.refused + (turn.ok is False)
            station.unanswered = station.unanswered + 1 if turn.ok is None else 0
            failures = station.unanswered if turn.ok is None else station.refused
            pause_ns = _pause_ns(failures, took_ns)
            station.not_before_ns = now_ns + (
                self._at_most(station, pause_ns, now_ns) if turn.ok is None else pause_ns
            )
            return
        station.silent = not turn.answered
        if turn.answered:
            station.silent_since_ns = None
        fruitful = turn.answered if isinstance(turn, Poll) else bool(turn.samples)
        station.fruitless = 0 if fruitful else station.fruitless + 1
        pause_ns = _pause_ns(station.fruitless, took_ns)
        station.not_before_ns = now_ns + (
            min(pause_ns, _ANSWERING_PAUSE * took_ns)
            if turn.answered
            else self._at_most(station, pause_ns, now_ns)
        )
        if isinstance(turn, Poll):
            station.doubted = 0
        if station.fruitless == 1 and isinstance(turn, Poll):
            # A round later there would be a gap in its track that nothing is interpolated over.
            self._round.remove(station)
            self._round.insert(0, station)
        if isinstance(turn, Synchronisation):
            if fruitful:
                self._synchronised(station, now_ns)
            elif station.synchronisations:  # the clock that is known will do a little longer
                station.due_ns = now_ns + self._cadence.first_interval_ns

    def _at_most(self, station: _Station, pause_ns: int, now_ns: int) -> int:
        """Return a pause that is short beside the silence that it follows: outages are mostly as long as they are already."""
        if station.silent_since_ns is None:
            station.silent_since_ns = self._began_ns
        return min(pause_ns, (now_ns - station.silent_since_ns) // _OUTAGE_SHARE)

    def resynchronise(self, station: int, now_ns: int) -> None:
        """Synchronise a station before anything else: its clock has been found to be another one.

        It may have been restarted, and then tracks the prism of its own configuration; so it is told its prism again.
        """
        found = self._station(station)
        found.urgent = True
        found.tracks = found.agreed = False
        found.due_ns = now_ns
        found.synchronisations = min(found.synchronisations, 1)

    def doubted(self, station: int, now_ns: int) -> None:
        """Synchronise a station once more: it may have got another clock during the synchronisation that has just ended.

        From the second time in a row on it has to wait, for others have only what it leaves.
        """
        self.resynchronise(station, now_ns)
        found = self._station(station)
        found.doubted += 1
        took_ns = now_ns - self._began_ns
        pause_ns = min(_pause_ns(found.doubted, took_ns), _ANSWERING_PAUSE * took_ns)
        found.not_before_ns = max(found.not_before_ns, now_ns + pause_ns)

    def _turn(self, station: _Station, now_ns: int) -> Task:
        plan = station.plan
        if not station.tracks and not station.silent:
            return CommandTransaction(plan.station, CommandMessage("n", plan.station, plan.prism), ORDER_TIMEOUT_NS)
        if station.tracks and station.synchronisations and not station.urgent:
            # A silent one is asked by polls, which cost least; but one that has missed the end of a synchronisation
            # answers no polls, so now and then it is a synchronisation again.
            stuck = station.fruitless > _STUCK_EVERY and station.fruitless % _STUCK_EVERY == 0
            if not stuck if station.silent else now_ns < max(station.due_ns, self._spaced_ns):
                return Poll(plan.station, self._timing)
        # At the start there is time for many cycles; a station that comes later must not keep the others waiting.
        running = any(other.synchronisations > 1 for other in self._round)
        first = station.synchronisations == 0 and not running
        cycles = self._cadence.initial_cycles if first else self._cadence.resync_cycles
        return Synchronisation(plan.station, cycles, self._timing, plan.stamp_delay_ns)

    def _synchronised(self, station: _Station, now_ns: int) -> None:
        cadence = self._cadence
        interval_ns = cadence.following_ns(station.synchronisations)
        station.synchronisations = min(station.synchronisations + 1, 20)
        station.urgent = False
        self._spaced_ns = now_ns + _SPACING_NS
        if interval_ns < cadence.interval_ns:
            station.due_ns = now_ns + interval_ns
            return
        # The last instant of the station's own within an interval from now.
        own_ns = self._start_ns + cadence.interval_ns * self._slots[station.plan.station] // len(self._slots)
        station.due_ns = own_ns + (now_ns - own_ns) // cadence.interval_ns * cadence.interval_ns
        station.due_ns += cadence.interval_ns

    def _station(self, number: int) -> _Station:
        return next(station for station in self._round if station.plan.station == number)


def _pause_ns(failures: int, took_ns: int) -> int:
    """How long to leave a station alone after so many fruitless turns in a row, the last of which took so long."""
    if failures <= 1:  # the packet may just have been lost
        return 0
    return took_ns * min(1 << min(failures - 1, 10), _LARGEST_PAUSE)


@dataclass(slots=True)
class _Station:
    """How it stands with one station.

    Attributes
    ----------
    tracks
        It has said that it tracks.
    silent, silent_since_ns
        It did not answer last; since when, None: it did.
    agreed
        It said so in answer to the last order; see ``tracks``.
    may_answer_ns
        Until then its answer to an order may still come, in the turn of another.
    fruitless, refused, unanswered
        Polls and synchronisations in a row that brought nothing; orders that were refused since one was carried out,
        and orders in a row without an answer.
    doubted
        Synchronisations in a row that left it open which clock the station has now.
    synchronisations
        How many there were since it was first heard or its clock was found to be another one.
    due_ns, urgent
        When the next one is due, and whether before anything else.
    not_before_ns
        Until then it is left alone.
    """

    plan: StationPlan
    tracks: bool = False
    silent: bool = False
    silent_since_ns: int | None = None
    agreed: bool = False
    may_answer_ns: int = 0
    fruitless: int = 0
    refused: int = 0
    unanswered: int = 0
    doubted: int = 0
    synchronisations: int = 0
    due_ns: int = 0
    urgent: bool = False
    not_before_ns: int = 0
