"""Schedules the transactions of the classic protocol on its one channel. Sans-I/O.

Round robin: each station gets the one transaction it needs most. A back-off of a multiple of its duration follows a
fruitless one; only the first fruitless poll is repeated at once. A station is commanded to track, synchronised, then
polled, even while silent, which is the cheapest way to notice its recovery. As a poll and the command to measure a target begin with the same
letter, a station that has not confirmed that it tracks is never polled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.radio.classic import CommandMessage, CommandTransaction, Poll, Synchronisation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.radio.classic import LinkTiming

COMMAND_TIMEOUT_NS = 1_000_000_000
"""A station that already tracks confirms at once. One that has to turn to its prism first takes longer and is asked again:
waiting for it would delay all others as much as a lost packet."""

MAX_RESPONSE_DELAY_NS = 20_000_000_000  # a station may respond to a command this late

FIRST_INTERVAL_NS = 30_000_000_000
"""From a station's first synchronisation to its second: until then the skew of its clock is poorly known."""
_INTERVAL_GROWTH = 3

_SYNCHRONISATION_SPACING_NS = 5_000_000_000
"""Between two synchronisations that are not urgent, so that the stations' tracks have no longer gap."""

_MAX_BACKOFF_FACTOR = 20
"""Back-off in durations of a fruitless transaction: a dead station gets a twentieth of the time."""

_RESPONDING_BACKOFF_FACTOR = 3
"""The same for a station that responds, but gives no samples or an inconclusive synchronisation: it may work with the
next packet."""

_MAX_BACKOFF_PER_SILENCE = 4  # the back-off of a silent station is at most its silence divided by this

_RESYNC_PROBE_INTERVAL = 4
"""Every fourth transaction with a silent station is a synchronisation, except among the first."""

ScheduledTransaction = Poll | Synchronisation | CommandTransaction


@dataclass(frozen=True, slots=True, kw_only=True)
class StationPlan:
    """A station to schedule."""

    station: int
    prism: int
    stamp_delay_ns: int = 0  # by how much its computer's reception stamps are late, in ns


@dataclass(frozen=True, slots=True, kw_only=True)
class SynchronisationSchedule:
    """How often clocks are synchronised."""

    initial_cycles: int  # cycles of a station's first synchronisation, at the start
    resync_cycles: int  # cycles of every other one
    interval_ns: int  # between synchronisations of a station, in ns. Stations are staggered evenly over it.
    first_interval_ns: int = FIRST_INTERVAL_NS
    """From the first to the second; it triples until it reaches ``interval_ns``."""

    def next_interval_ns(self, earlier: int) -> int:
        """Return the time to the next synchronisation after ``earlier`` previous ones and this one, in ns."""
        grown_ns: int = self.first_interval_ns * _INTERVAL_GROWTH**earlier
        return min(grown_ns, self.interval_ns)


class Scheduler:
    """Chooses transactions, one at a time, with ``stations`` in the order of the round; instants on any one clock."""

    def __init__(
        self,
        stations: Sequence[StationPlan],
        schedule: SynchronisationSchedule,
        timing: LinkTiming,
        start_ns: int,
    ) -> None:
        self._round = [_Station(plan) for plan in stations]
        self._schedule = schedule
        self._timing = timing
        self._start_ns = start_ns
        self._slots = {plan.station: number for number, plan in enumerate(stations, start=1)}
        self._started_ns = start_ns
        self._spaced_ns = start_ns

    def next(self, now_ns: int) -> ScheduledTransaction | int:
        """Return the next transaction, or until when every station is backed off.

        A transaction that was aborted because the radio failed need not be passed to :meth:`finished`.
        """
        urgent = [s for s in self._round if s.urgent and s.not_before_ns <= now_ns]
        ready = urgent or [s for s in self._round if s.not_before_ns <= now_ns]
        if not ready:
            return min(station.not_before_ns for station in self._round)
        station = ready[0]
        self._round.remove(station)
        self._round.append(station)
        self._started_ns = now_ns
        return self._transaction(station, now_ns)

    def finished(self, transaction: ScheduledTransaction, now_ns: int) -> None:
        """Take the result of the transaction that :meth:`next` returned last."""
        station = self._station(transaction.station)
        took_ns = now_ns - self._started_ns
        if isinstance(transaction, CommandTransaction):
            # The response does not state its station: it may be a late one of another. A station is late only once.
            sure = station.confirmed or not any(
                other is not station and now_ns < other.may_respond_until_ns for other in self._round
            )
            station.silent, station.tracks = transaction.ok is None, bool(transaction.ok) and sure
            station.confirmed = bool(transaction.ok)
            if transaction.ok is not None:
                station.silent_since_ns = None
            station.may_respond_until_ns = now_ns + MAX_RESPONSE_DELAY_NS if transaction.ok is None else 0
            # A refusal costs little and a lost packet a lot: refusals do not extend the back-off after a loss.
            station.refused = 0 if transaction.ok else station.refused + (transaction.ok is False)
            station.unanswered = station.unanswered + 1 if transaction.ok is None else 0
            failures = station.unanswered if transaction.ok is None else station.refused
            pause_ns = _pause_ns(failures, took_ns)
            station.not_before_ns = now_ns + (
                self._limited_by_silence(station, pause_ns, now_ns) if transaction.ok is None else pause_ns
            )
            return
        station.silent = not transaction.has_reply
        if transaction.has_reply:
            station.silent_since_ns = None
        fruitful = transaction.has_reply if isinstance(transaction, Poll) else bool(transaction.samples)
        station.fruitless = 0 if fruitful else station.fruitless + 1
        pause_ns = _pause_ns(station.fruitless, took_ns)
        station.not_before_ns = now_ns + (
            min(pause_ns, _RESPONDING_BACKOFF_FACTOR * took_ns)
            if transaction.has_reply
            else self._limited_by_silence(station, pause_ns, now_ns)
        )
        if isinstance(transaction, Poll):
            station.inconclusive = 0
        if station.fruitless == 1 and isinstance(transaction, Poll):
            # A round later the gap in its track would be too long to interpolate.
            self._round.remove(station)
            self._round.insert(0, station)
        if isinstance(transaction, Synchronisation):
            if fruitful:
                self._synchronised(station, now_ns)
            elif station.synchronisations:  # the known clock suffices a little longer
                station.due_ns = now_ns + self._schedule.first_interval_ns

    def _limited_by_silence(self, station: _Station, pause_ns: int, now_ns: int) -> int:
        """Limit a back-off by the silence so far: an outage usually lasts about as long again."""
        if station.silent_since_ns is None:
            station.silent_since_ns = self._started_ns
        return min(pause_ns, (now_ns - station.silent_since_ns) // _MAX_BACKOFF_PER_SILENCE)

    def resynchronise(self, station: int, now_ns: int) -> None:
        """Synchronise a station before anything else: its clock was stepped or reset.

        It may have restarted and track the prism of its own configuration, so the command to track is repeated.
        """
        found = self._station(station)
        found.urgent = True
        found.tracks = found.confirmed = False
        found.due_ns = now_ns
        found.synchronisations = min(found.synchronisations, 1)

    def synchronisation_inconclusive(self, station: int, now_ns: int) -> None:
        """Synchronise a station again: its clock may have been reset during the synchronisation that has just ended.

        From the second time in a row on it is backed off, to leave time to the others.
        """
        self.resynchronise(station, now_ns)
        found = self._station(station)
        found.inconclusive += 1
        took_ns = now_ns - self._started_ns
        pause_ns = min(_pause_ns(found.inconclusive, took_ns), _RESPONDING_BACKOFF_FACTOR * took_ns)
        found.not_before_ns = max(found.not_before_ns, now_ns + pause_ns)

    def _transaction(self, station: _Station, now_ns: int) -> ScheduledTransaction:
        plan = station.plan
        if not station.tracks and not station.silent:
            return CommandTransaction(
                plan.station, CommandMessage("n", plan.station, plan.prism), COMMAND_TIMEOUT_NS
            )
        if station.tracks and station.synchronisations and not station.urgent:
            # Polls cost least. But a station that missed the end of a synchronisation does not respond to them, so now
            # and then it is synchronised.
            stuck = (
                station.fruitless > _RESYNC_PROBE_INTERVAL and station.fruitless % _RESYNC_PROBE_INTERVAL == 0
            )
            if not stuck if station.silent else now_ns < max(station.due_ns, self._spaced_ns):
                return Poll(plan.station, self._timing)
        # At the start there is time for many cycles; a station that joins later must not delay the others.
        running = any(other.synchronisations > 1 for other in self._round)
        first = station.synchronisations == 0 and not running
        cycles = self._schedule.initial_cycles if first else self._schedule.resync_cycles
        return Synchronisation(plan.station, cycles, self._timing, plan.stamp_delay_ns)

    def _synchronised(self, station: _Station, now_ns: int) -> None:
        schedule = self._schedule
        interval_ns = schedule.next_interval_ns(station.synchronisations)
        station.synchronisations = min(station.synchronisations + 1, 20)
        station.urgent = False
        self._spaced_ns = now_ns + _SYNCHRONISATION_SPACING_NS
        if interval_ns < schedule.interval_ns:
            station.due_ns = now_ns + interval_ns
            return
        # The next instant of the station's own phase of the interval.
        own_ns = self._start_ns + schedule.interval_ns * self._slots[station.plan.station] // len(self._slots)
        station.due_ns = own_ns + (now_ns - own_ns) // schedule.interval_ns * schedule.interval_ns
        station.due_ns += schedule.interval_ns

    def _station(self, number: int) -> _Station:
        return next(station for station in self._round if station.plan.station == number)


def _pause_ns(failures: int, took_ns: int) -> int:
    """Return the back-off after consecutive failures, the last of which took ``took_ns``: exponential, limited."""
    if failures <= 1:  # a single lost packet
        return 0
    return took_ns * min(1 << min(failures - 1, 10), _MAX_BACKOFF_FACTOR)


@dataclass(slots=True)
class _Station:
    """State of one station."""

    plan: StationPlan
    tracks: bool = False  # it has confirmed that it tracks
    silent: bool = False  # it did not respond to the last request
    silent_since_ns: int | None = None  # since when; None: it responded
    confirmed: bool = False  # it confirmed in response to the last command; see ``tracks``
    may_respond_until_ns: int = 0
    """Until then its response to a command may still arrive, in a transaction of another station."""
    fruitless: int = 0
    refused: int = 0
    unanswered: int = 0
    """Consecutive polls and synchronisations without a result; commands refused since one was executed, and consecutive
    commands without a response."""
    inconclusive: int = 0  # consecutive synchronisations that may have been of an earlier clock
    synchronisations: int = 0  # since the station was first received or its clock was reset
    due_ns: int = 0  # when the next one is due
    urgent: bool = False  # whether it is due before anything else
    not_before_ns: int = 0  # end of the back-off
