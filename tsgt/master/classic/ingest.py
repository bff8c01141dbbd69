"""From the stations' messages to measurements on the master's clock. Pure.

A station answers every poll, so most of what comes it has said before; and its clock may have been anything.
Each new message is put on the master's clock, unless its time shows that the station's clock is no longer the one
that was synchronised: then it waits, with all that follow, for the next synchronisation.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from tsgt.model import PolarMeasurement, Status
from tsgt.radio.classic import OK, status_of
from tsgt.recording import ClockRecord
from tsgt.timesync.offset_regression import highest_offset_ns
from tsgt.timesync.two_way import TimestampCheck

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from tsgt.model import ClockSample
    from tsgt.radio.classic import MeasurementMessage
    from tsgt.timesync.two_way import ClockEstimate, ClockFilter

UNTIMED_SIGMA_NS = 1_000_000_000
"""One sigma of a stamp that is only the time of arrival: an error message of the authors' nodes has no other."""

SILENCE_NS = 5_000_000_000
"""A station that was silent for longer may have been switched off and on, and have another clock; no computer that
a station client runs on starts faster."""

RESTART_NS = 500_000_000
"""No client is started again within this. It may have another clock then: that of its computer was set meanwhile."""

STALE_NS = 1_000_000_000
"""Instruments that track measure more often than this. A new measurement that looks older may be one of a clock that
stood still, or was set back, while nobody asked the station."""

HELD_MEASUREMENTS = 100
"""How many wait for a synchronisation at most; the oldest goes first."""

KNOWN_MEASUREMENTS = 1000
"""So many of the last ones are known when they come again, played back by somebody or out of a radio's buffer."""


class Intake:
    """Judges and stamps what the stations answer.

    Parameters
    ----------
    prisms
        Number of the prism by number of the station that tracks it.
    new_filter
        Makes the filter of one station's clock.
    stamp_delays_ns
        By station, where there is one: how late its computer stamps receptions on average, in ns; as much as that
        one stamp may be off by.
    """

    def __init__(
        self,
        prisms: Mapping[int, int],
        new_filter: Callable[[], ClockFilter],
        stamp_delays_ns: Mapping[int, int] | None = None,
    ) -> None:
        delays_ns = stamp_delays_ns or {}
        self._stations = {
            station: _Station(station, prism, new_filter(), delays_ns.get(station, 0))
            for station, prism in prisms.items()
        }

    def answered(self, message: MeasurementMessage, *, requested_ns: int, received_ns: int) -> Arrival:
        """Take the answer to a poll.

        Parameters
        ----------
        message
            The answer, of a station that is known.
        requested_ns
            When the request for it began, on the master's Unix clock in ns.
        received_ns
            When it had been received, on the same clock.
        """
        return self._stations[message.station].answered(message, requested_ns, received_ns)

    def unanswered(self, station: int) -> None:
        """Take note that a station did not answer."""
        self._stations[station].unanswered()

    def doubt(self, station: int) -> None:
        """Hold a station's measurements until it is synchronised: it may have been restarted, with another clock."""
        self._stations[station].doubt()

    def synchronised(self, station: int, samples: Sequence[ClockSample], now_ns: int) -> Synchronised:
        """Take the exchanges of a synchronisation, at least one; what was held is stamped and let go."""
        return self._stations[station].synchronised(samples, now_ns)

    def clock(self, station: int, now_ns: int) -> ClockEstimate | None:
        """Return what a station's clock shows against the master's at an instant; None while nobody knows."""
        return self._stations[station].clock(now_ns)


class Arrival(NamedTuple):
    """What came of an answer.

    Attributes
    ----------
    measurement
        For pipeline and stream; None where there is nothing new, or it has to wait.
    stepped
        The station's clock has just been found to be another one.
    doubtful
        The station has to be synchronised before its measurements can be used: it stepped, was silent, begins anew,
        or sends what looks old.
    """

    measurement: PolarMeasurement | None = None
    stepped: bool = False
    doubtful: bool = False


class Synchronised(NamedTuple):
    """What came of a synchronisation.

    Attributes
    ----------
    record
        For the stream.
    measurements
        Those that waited for it and are of this clock, in the order of their arrival.
    stepped
        It has just been found that the station's clock is another one than before.
    """

    record: ClockRecord
    measurements: list[PolarMeasurement]
    stepped: bool


@dataclass(frozen=True, slots=True)
class _Untimed:
    """What an error message without a time is known by."""

    raw_status: int


class _Station:
    """One station's clock and what was last heard from it."""

    def __init__(self, station: int, prism: int, clock: ClockFilter, stamp_delay_ns: int) -> None:
        self._station = station
        self._prism = prism
        self._clock = clock
        self._stamp_delay_ns = stamp_delay_ns
        self._check = TimestampCheck()
        self._offset_ns: int | None = None
        self._last: int | _Untimed | None = None
        self._known: deque[int] = deque(maxlen=KNOWN_MEASUREMENTS)
        self._held: deque[tuple[MeasurementMessage, int]] = deque(maxlen=HELD_MEASUREMENTS)
        self._sequence = 0
        self._heard_ns: int | None = None
        self._doubtful = False
        self._had_nothing = False
        self._missed = False
        self._held_of_before = False
        """Its program may have been started again since what is held was measured, with another clock."""

    def unanswered(self) -> None:
        self._missed = True
        self._held_of_before = bool(self._held)

    def doubt(self) -> None:
        self._doubtful = True

    def answered(self, message: MeasurementMessage, requested_ns: int, received_ns: int) -> Arrival:
        unasked = self._heard_ns is not None and received_ns - self._heard_ns > SILENCE_NS
        missed = self._missed or unasked
        back = self._is_back(received_ns)
        if message.time_ns == 0:
            self._check.no_new_measurement(requested_ns)
            if message.status == OK or not (message.zenith_angle_rad or message.horizontal_angle_rad):
                # It has not measured anything yet.
                self._had_nothing = True
                return Arrival(doubtful=self._begins_anew(missed=missed) or back)
            return Arrival(self._untimed(message, received_ns), doubtful=back)
        if message.time_ns in self._known:
            if message.time_ns == self._last:  # and not an older one that somebody plays back
                self._check.no_new_measurement(requested_ns)
            return Arrival(doubtful=back)
        present = self.clock(received_ns)
        if present is None or self._doubtful:
            self._hold(message, received_ns)
            return Arrival(doubtful=back)
        # By the clock as it is now: carried back to a time of years ago its bound would excuse anything.
        stamp_ns, timed = message.time_ns - present.offset_ns, _timed(message)
        possible = self._check.check(
            stamp_ns, requested_ns=requested_ns, received_ns=received_ns, bound_ns=present.bound_ns
        )
        stale = stamp_ns < requested_ns - present.bound_ns - STALE_NS
        if not timed and (stale or not possible):  # an authors' node has no time for its errors
            told = self._untimed(message, received_ns)
            if told is not None and not _has_no_values(message):
                # It has a time of its own, by which it would be told again after the next synchronisation.
                self._known.append(message.time_ns)
            return Arrival(told)
        if not possible:
            self._offset_ns = None
            self._clock.forget()
            self._check = TimestampCheck()
            self._hold(message, received_ns)
            return Arrival(stepped=True, doubtful=True)
        if stale or self._had_nothing:  # between the nothing and this its program may have been started again
            self._doubtful = True
            self._hold(message, received_ns)
            return Arrival(doubtful=True)
        self._take(message)
        return Arrival(self._measurement(message, received_ns))

    def _take(self, message: MeasurementMessage) -> None:
        self._last = message.time_ns
        self._known.append(message.time_ns)

    def _hold(self, message: MeasurementMessage, received_ns: int) -> None:
        self._take(message)
        self._held.append((message, received_ns))

    def _begins_anew(self, *, missed: bool) -> bool:
        """Tell whether the program of a station without a measurement was started again.

        It was if there was a measurement before, and may have been if a request was lost, or if it was not asked for so
        long that it can have come back unnoticed.
        """
        anew, self._last = missed or self._last is not None, None
        self._doubtful = self._doubtful or anew
        self._held_of_before = self._held_of_before or (anew and bool(self._held))
        return anew

    def _is_back(self, received_ns: int) -> bool:
        """Tell whether this is the first answer after a silence in which the station may have got another clock.

        What it says then cannot be judged by its time alone: a clock that has stood still meanwhile makes a new
        measurement look like one from before.
        """
        silent = self._missed and self._heard_ns is not None and received_ns - self._heard_ns > SILENCE_NS
        self._heard_ns, self._missed = received_ns, False
        self._doubtful = self._doubtful or silent
        return silent

    def synchronised(self, samples: Sequence[ClockSample], now_ns: int) -> Synchronised:
        newest = samples[-1]
        if self._heard_ns is None or samples[0].sent_ns - self._heard_ns > RESTART_NS:
            self._held_of_before = bool(self._held)
        known = self._offset_ns is not None
        doubtful = self._doubtful
        forgotten = known and doubtful and not self._agrees(newest)
        if forgotten:
            self._clock.forget()  # the paper's filter would go there a tenth of the way
        self._missed = False
        self._heard_ns, self._doubtful, self._had_nothing = now_ns, False, False
        before = self._by_the_clock_before() if known and not forgotten else {}
        updated = self._clock.update(samples, anew=doubtful)
        another = self._held_of_before and (updated.restarted or not known)
        stepped = updated.restarted and known
        self._offset_ns = newest.station_ns - newest.sent_ns - newest.forward_ns
        # The first, rough offset says when "now" is over there.
        self._offset_ns = self._clock.at(now_ns + self._offset_ns).offset_ns
        estimate = self._at(now_ns + self._offset_ns)
        record = ClockRecord(
            stamp_ns=now_ns,
            station=self._station,
            filter=self._clock.name,
            offset_ns=estimate.offset_ns,
            frequency_ppm=estimate.frequency_ppm,
            sigma_ns=estimate.sigma_ns,
            bound_ns=estimate.bound_ns,
            restarted=updated.restarted,
            samples=tuple(samples),
            rejected=updated.rejected,
        )
        released = [
            self._released(*held, None if another else estimate, before.get(held[0].time_ns))
            for held in self._held
        ]
        self._held.clear()
        self._held_of_before = False
        return Synchronised(record, [m for m in released if m is not None], stepped)

    def _by_the_clock_before(self) -> dict[int, int]:
        """Return the offset in ns of each that is held, if it may be of the clock that was known so far."""
        held = self._held if self._held_of_before else ()
        return {message.time_ns: self._clock.at(message.time_ns).offset_ns for message, _ in held}

    def _agrees(self, sample: ClockSample) -> bool:
        """Whether an exchange is possible with the clock as it is known."""
        estimate = self._at(sample.station_ns)
        highest_ns = highest_offset_ns(sample) + estimate.bound_ns
        lowest_ns = highest_offset_ns(sample) - max(sample.excess_ns, 0) - estimate.bound_ns
        return lowest_ns <= estimate.offset_ns <= highest_ns

    def clock(self, now_ns: int) -> ClockEstimate | None:
        return None if self._offset_ns is None else self._at(now_ns + self._offset_ns)

    def _at(self, station_ns: int) -> ClockEstimate:
        estimate = self._clock.at(station_ns)
        return replace(estimate, bound_ns=estimate.bound_ns + self._stamp_delay_ns)

    def _untimed(self, message: MeasurementMessage, received_ns: int) -> PolarMeasurement | None:
        """Take an error without a time, or with one that cannot be, once until something else comes."""
        known_by = _Untimed(message.status)
        if known_by == self._last:
            return None
        self._last = known_by
        return self._record(message, received_ns, received_ns, UNTIMED_SIGMA_NS)

    def _released(
        self,
        message: MeasurementMessage,
        received_ns: int,
        present: ClockEstimate | None,
        before_ns: int | None,
    ) -> PolarMeasurement | None:
        """Stamp what was held, if it can be of the clock that has been found and not of one before that.

        ``before_ns`` is the offset by the clock that was known so far, where it may be of that one: it may have stepped by
        less than exchanges tell.
        """
        if present is not None:
            stamp_ns = message.time_ns - present.offset_ns
            if received_ns - 2 * STALE_NS <= stamp_ns <= received_ns + present.bound_ns:
                return self._measurement(message, received_ns, before_ns)
        if _timed(message):
            return None  # nobody knows when it was; the station's journal has it
        return self._record(message, received_ns, received_ns, UNTIMED_SIGMA_NS)

    def _measurement(
        self, message: MeasurementMessage, received_ns: int, before_ns: int | None = None
    ) -> PolarMeasurement:
        estimate = self._clock.at(message.time_ns)
        stepped_ns = 0 if before_ns is None else abs(estimate.offset_ns - before_ns)
        return self._record(
            message,
            received_ns,
            message.time_ns - estimate.offset_ns,
            round(math.hypot(estimate.sigma_ns, stepped_ns)),
            estimate.bound_ns + self._stamp_delay_ns + stepped_ns,
        )

    def _record(
        self,
        message: MeasurementMessage,
        received_ns: int,
        stamp_ns: int,
        sigma_ns: int,
        bound_ns: int | None = None,
    ) -> PolarMeasurement:
        self._sequence += 1
        return PolarMeasurement(
            station=self._station,
            prism=self._prism,
            sequence=self._sequence - 1,
            stamp_ns=stamp_ns,
            stamp_sigma_ns=sigma_ns,
            stamp_bound_ns=bound_ns,
            received_ns=received_ns,
            horizontal_angle_rad=message.horizontal_angle_rad,
            zenith_angle_rad=message.zenith_angle_rad,
            slope_distance_m=message.slope_distance_m if message.slope_distance_m > 0 else None,
            status=status_of(message),
            raw_status=message.status,
            host_time_ns=message.time_ns,
        )


def _has_no_values(message: MeasurementMessage) -> bool:
    """Whether this is an error of an authors' node: -1 for all values, and a time that means nothing."""
    return message.zenith_angle_rad < 0


def _timed(message: MeasurementMessage) -> bool:
    """Whether every node has a time for it: an authors' node has none for its errors."""
    return status_of(message) in (Status.OK, Status.ANGLE_ONLY)
