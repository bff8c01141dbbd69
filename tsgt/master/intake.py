"""From the stations' messages to measurements on the master's clock. Pure.

A station answers every poll, so most of what comes it has said before; and its clock may have been anything.
Each new message is put on the master's clock, unless its time shows that the station's clock is no longer the one
that was synchronised: then it waits, with all that follow, for the next synchronisation.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from tsgt.master.clock_offset import ArrivalCheck
from tsgt.master.stream_records import ClockRecord
from tsgt.model import LAST_INSTANT_NS, PolarMeasurement, Status
from tsgt.radio.classic_messages import OK, status_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from tsgt.master.clock_offset import ClockEstimate, ClockFilter
    from tsgt.model import ClockSample
    from tsgt.radio.classic_messages import MeasurementMessage

UNTIMED_SIGMA_NS = 1_000_000_000
"""One sigma of a stamp that is only the time of arrival: an error message of the authors' nodes has no other."""

SILENCE_NS = 5_000_000_000
"""A station that was silent for longer may have been switched off and on, and have another clock; no computer that
a station client runs on starts faster."""

HELD_MEASUREMENTS = 100
"""How many wait for a synchronisation at most; the oldest goes first."""


class Intake:
    """Judges and stamps what the stations answer.

    Parameters
    ----------
    prisms
        Number of the prism by number of the station that tracks it.
    new_filter
        Makes the filter of one station's clock.
    """

    def __init__(self, prisms: Mapping[int, int], new_filter: Callable[[], ClockFilter]) -> None:
        self._stations = {
            station: _Station(station, prism, new_filter()) for station, prism in prisms.items()
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
        self._stations[station].missed = True

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
        The station has to be synchronised before its measurements can be used: it stepped, or was silent.
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
        Those that waited for it, in the order of their arrival.
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

    def __init__(self, station: int, prism: int, clock: ClockFilter) -> None:
        self._station = station
        self._prism = prism
        self._clock = clock
        self._check = ArrivalCheck()
        self._offset_ns: int | None = None
        self._last: int | _Untimed | None = None
        self._held: deque[tuple[MeasurementMessage, int]] = deque(maxlen=HELD_MEASUREMENTS)
        self._sequence = 0
        self._heard_ns: int | None = None
        self._doubtful = False
        self.missed = False

    def answered(self, message: MeasurementMessage, requested_ns: int, received_ns: int) -> Arrival:
        status = status_of(message)
        back = self._is_back(received_ns)
        if message.time_ns == 0:
            self._check.nothing_new(requested_ns)
            if message.status == OK or not (message.zenith_angle_rad or message.horizontal_angle_rad):
                return Arrival(doubtful=back)  # it has not measured anything yet
            return Arrival(self._untimed(message, received_ns), doubtful=back)
        if message.time_ns == self._last:
            self._check.nothing_new(requested_ns)
            return Arrival(doubtful=back)
        present = self.clock(received_ns)
        if present is None or self._doubtful:
            self._last = message.time_ns
            self._held.append((message, received_ns))
            return Arrival(doubtful=back)
        # By the clock as it is now: carried back to a time of years ago its bound would excuse anything.
        if not self._check.check(
            message.time_ns - present.offset_ns,
            requested_ns=requested_ns,
            received_ns=received_ns,
            bound_ns=present.bound_ns,
        ):
            if status not in (Status.OK, Status.ANGLE_ONLY):  # an authors' node has no time for its errors
                return Arrival(self._untimed(message, received_ns))
            self._last = message.time_ns
            self._offset_ns = None
            self._clock.forget()
            self._check = ArrivalCheck()
            self._held.append((message, received_ns))
            return Arrival(stepped=True, doubtful=True)
        self._last = message.time_ns
        return Arrival(self._measurement(message, received_ns))

    def _is_back(self, received_ns: int) -> bool:
        """Tell whether this is the first answer after a silence in which the station may have got another clock.

        What it says then cannot be judged by its time alone: a clock that has stood still meanwhile makes a new
        measurement look like one from before.
        """
        silent = self.missed and self._heard_ns is not None and received_ns - self._heard_ns > SILENCE_NS
        self._heard_ns, self.missed = received_ns, False
        self._doubtful = self._doubtful or silent
        return silent

    def synchronised(self, samples: Sequence[ClockSample], now_ns: int) -> Synchronised:
        self._heard_ns, self.missed, self._doubtful = now_ns, False, False
        updated = self._clock.update(samples)
        stepped = updated.restarted and self._offset_ns is not None
        newest = samples[-1]
        self._offset_ns = newest.station_ns - newest.sent_ns - newest.forward_ns
        # The first, rough offset says when "now" is over there.
        self._offset_ns = self._clock.at(now_ns + self._offset_ns).offset_ns
        estimate = self._clock.at(now_ns + self._offset_ns)
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
        measurements = [self._measurement(message, received_ns) for message, received_ns in self._held]
        self._held.clear()
        return Synchronised(record, measurements, stepped)

    def clock(self, now_ns: int) -> ClockEstimate | None:
        return None if self._offset_ns is None else self._clock.at(now_ns + self._offset_ns)

    def _untimed(self, message: MeasurementMessage, received_ns: int) -> PolarMeasurement | None:
        """Take an error without a time, or with one that cannot be, once until something else comes."""
        known_by = _Untimed(message.status)
        if known_by == self._last:
            return None
        self._last = known_by
        return self._record(message, received_ns, received_ns, UNTIMED_SIGMA_NS)

    def _measurement(self, message: MeasurementMessage, received_ns: int) -> PolarMeasurement:
        estimate = self._clock.at(message.time_ns)
        stamp_ns = message.time_ns - estimate.offset_ns
        if not 0 <= stamp_ns <= LAST_INSTANT_NS:  # held, and of a clock that has been set once more since
            record = self._record(message, received_ns, received_ns, UNTIMED_SIGMA_NS)
            return replace(record, status=Status.ERROR)  # nobody knows when it was, so no pose may have it
        return self._record(message, received_ns, stamp_ns, estimate.sigma_ns)

    def _record(
        self, message: MeasurementMessage, received_ns: int, stamp_ns: int, sigma_ns: int
    ) -> PolarMeasurement:
        self._sequence += 1
        return PolarMeasurement(
            station=self._station,
            prism=self._prism,
            sequence=self._sequence - 1,
            stamp_ns=stamp_ns,
            stamp_sigma_ns=sigma_ns,
            received_ns=received_ns,
            horizontal_angle_rad=message.horizontal_angle_rad,
            zenith_angle_rad=message.zenith_angle_rad,
            slope_distance_m=message.slope_distance_m if message.slope_distance_m > 0 else None,
            status=status_of(message),
            raw_status=message.status,
            host_time_ns=message.time_ns,
        )
