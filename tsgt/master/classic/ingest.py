"""Converts the stations' replies to measurements on the master's clock. Sans-I/O.

A station answers every poll, so most replies repeat an earlier one, and its clock may have changed meanwhile. Each new
measurement is converted to the master's clock, unless the station's clock may no longer be the synchronised one: then
it is held, with all that follow, until the next synchronisation.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import TYPE_CHECKING, NamedTuple

from tsgt.model import PolarMeasurement, Status
from tsgt.radio.classic import OK, status_of
from tsgt.recording import ClockRecord
from tsgt.timesync.two_way import TimestampCheck

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ClockSample
    from tsgt.radio.classic import MeasurementMessage
    from tsgt.timesync.two_way import ClockEstimate, ClockFilter

UNTIMED_SIGMA_NS = 1_000_000_000
"""One sigma of a stamp that is only the time of arrival: an error message of the authors' nodes has no other."""

SILENCE_TIMEOUT_NS = 5_000_000_000
"""A station that was silent for longer may have been power-cycled and have another clock; no computer that runs a
station client boots faster."""

MIN_RESTART_NS = 500_000_000
"""No client restarts faster than this. After a restart it may have another clock: that of its computer may have been set."""

STALE_THRESHOLD_NS = 1_000_000_000
"""Tracking instruments measure more often than this. A new measurement that appears older may be of a clock that was
stopped or set back while the station was not polled."""

HELD_CAPACITY = 100  # measurements that are held until a synchronisation; beyond that the oldest are dropped

DUPLICATE_WINDOW = 1000  # the last measurements among which a repeated or replayed one is recognised


class ClockState(Enum):
    """What is known of a station's clock."""

    UNSYNCHRONISED = auto()  # no offset is known; measurements are held
    SYNCHRONISED = auto()  # measurements are converted with the known offset
    AWAITING_MEASUREMENT = auto()
    """Synchronised, but the station has reported that it has not measured yet. It may have restarted before its first
    measurement, so that one needs a synchronisation."""
    SUSPENDED = auto()  # the station may have another clock than the synchronised one; measurements are held

    @property
    def holds(self) -> bool:
        """Whether measurements are held until the next synchronisation."""
        return self in (ClockState.UNSYNCHRONISED, ClockState.SUSPENDED)


class ClockEvent(Enum):
    """What changes the state of a station's clock."""

    SYNCHRONISATION = auto()
    NO_MEASUREMENT_YET = auto()
    POSSIBLE_RESTART = auto()
    IMPOSSIBLE_TIMESTAMP = auto()


_TRANSITIONS = {
    ClockEvent.SYNCHRONISATION: dict.fromkeys(ClockState, ClockState.SYNCHRONISED),
    ClockEvent.NO_MEASUREMENT_YET: {ClockState.SYNCHRONISED: ClockState.AWAITING_MEASUREMENT},
    ClockEvent.POSSIBLE_RESTART: {
        ClockState.SYNCHRONISED: ClockState.SUSPENDED,
        ClockState.AWAITING_MEASUREMENT: ClockState.SUSPENDED,
    },
    ClockEvent.IMPOSSIBLE_TIMESTAMP: {
        ClockState.SYNCHRONISED: ClockState.UNSYNCHRONISED,
        ClockState.AWAITING_MEASUREMENT: ClockState.UNSYNCHRONISED,
    },
}


def next_clock_state(state: ClockState, event: ClockEvent) -> ClockState:
    """Return the state after an event; a transition that the table does not list leaves it unchanged."""
    return _TRANSITIONS[event].get(state, state)


class PollResult(NamedTuple):
    """The result of a poll."""

    measurement: PolarMeasurement | None = None  # None where there is nothing new, or it is held
    stepped: bool = False  # the station's clock was just found to have been stepped or reset
    needs_synchronisation: bool = False
    """The station has to be synchronised before its measurements can be used: its clock stepped, it was silent, it may
    have restarted, or a measurement appears old."""


class SynchronisationResult(NamedTuple):
    """The result of a synchronisation."""

    record: ClockRecord
    measurements: list[PolarMeasurement]
    """Those that were held and belong to this clock, in the order of their arrival."""
    stepped: bool  # the station's clock was just found to have been stepped or reset


@dataclass(frozen=True, slots=True)
class _Untimed:
    """Identifies an error message without a time."""

    raw_status: int


class StationIngest:
    """Validates and stamps the replies of one station.

    ``stamp_delay_ns``: by how much its computer's reception stamps are late on average, in ns. A single stamp may be
    off by as much. ``state``: what is known of the station's clock.
    """

    def __init__(self, station: int, prism: int, clock: ClockFilter, stamp_delay_ns: int = 0) -> None:
        self.state = ClockState.UNSYNCHRONISED
        self._station = station
        self._prism = prism
        self._clock = clock
        self._stamp_delay_ns = stamp_delay_ns
        self._check = TimestampCheck()
        self._offset_ns = 0
        """Rough offset, to read the filter at the present; meaningless while unsynchronised."""
        self._last: int | _Untimed | None = None
        self._known: deque[int] = deque(maxlen=DUPLICATE_WINDOW)
        self._held: deque[tuple[MeasurementMessage, int]] = deque(maxlen=HELD_CAPACITY)
        self._held_before_restart = False
        """The station may have restarted, with another clock, after a held measurement."""
        self._sequence = 0
        self._received_ns: int | None = None
        self._unanswered = False
        """A request after the last reply was not answered."""

    def no_response(self) -> None:
        """Record that the station did not respond to a request."""
        self._unanswered = True
        self._held_before_restart = bool(self._held)

    def suspend(self) -> None:
        """Hold measurements until the station is synchronised: it may have restarted with another clock."""
        self._handle(ClockEvent.POSSIBLE_RESTART)

    def _handle(self, event: ClockEvent) -> None:
        self.state = next_clock_state(self.state, event)

    def reply(self, message: MeasurementMessage, *, requested_ns: int, received_ns: int) -> PollResult:
        """Take the reply to a poll.

        ``requested_ns`` is the start of the request's transmission, ``received_ns`` the end of the reply's reception, both
        on the master's Unix clock.
        """
        not_polled = self._received_ns is not None and received_ns - self._received_ns > SILENCE_TIMEOUT_NS
        unnoticed_restart = self._unanswered or not_polled
        was_silent = self._end_silence(received_ns)
        if message.time_ns == 0:
            self._check.no_new_measurement(requested_ns)
            if message.status == OK or not (message.zenith_angle_rad or message.horizontal_angle_rad):
                self._handle(ClockEvent.NO_MEASUREMENT_YET)
                restarted = self._no_measurement_yet(unnoticed_restart=unnoticed_restart)
                return PollResult(needs_synchronisation=restarted or was_silent)
            return PollResult(self._untimed(message, received_ns), needs_synchronisation=was_silent)
        if message.time_ns in self._known:
            if message.time_ns == self._last:  # not an older one that was replayed
                self._check.no_new_measurement(requested_ns)
            return PollResult(needs_synchronisation=was_silent)
        present = self.clock(received_ns)
        if present is None or self.state.holds:
            self._hold(message, received_ns)
            return PollResult(needs_synchronisation=was_silent)
        # The bound of the present: extrapolated to a time years ago it would accept anything.
        stamp_ns, timed = message.time_ns - present.offset_ns, _timed(message)
        possible = self._check.check(
            stamp_ns, requested_ns=requested_ns, received_ns=received_ns, bound_ns=present.bound_ns
        )
        stale = stamp_ns < requested_ns - present.bound_ns - STALE_THRESHOLD_NS
        if not timed and (stale or not possible):  # an authors' node has no time for its errors
            error = self._untimed(message, received_ns)
            if error is not None and not _has_no_values(message):
                # It has a valid time, by which the next synchronisation would release it a second time.
                self._known.append(message.time_ns)
            return PollResult(error)
        if not possible:
            self._handle(ClockEvent.IMPOSSIBLE_TIMESTAMP)
            self._clock.reset()
            self._check = TimestampCheck()
            self._hold(message, received_ns)
            return PollResult(stepped=True, needs_synchronisation=True)
        if stale or self.state is ClockState.AWAITING_MEASUREMENT:
            self.suspend()
            self._hold(message, received_ns)
            return PollResult(needs_synchronisation=True)
        self._remember(message)
        return PollResult(self._measurement(message, received_ns))

    def _remember(self, message: MeasurementMessage) -> None:
        self._last = message.time_ns
        self._known.append(message.time_ns)

    def _hold(self, message: MeasurementMessage, received_ns: int) -> None:
        self._remember(message)
        self._held.append((message, received_ns))

    def _no_measurement_yet(self, *, unnoticed_restart: bool) -> bool:
        """Return whether a station that has no measurement yet has restarted, or may have, unnoticed."""
        restarted, self._last = unnoticed_restart or self._last is not None, None
        if restarted:
            self.suspend()
            self._held_before_restart = bool(self._held)
        return restarted

    def _end_silence(self, received_ns: int) -> bool:
        """Return whether this ends a silence in which the station may have got another clock: its time proves nothing."""
        silent = (
            self._unanswered
            and self._received_ns is not None
            and received_ns - self._received_ns > SILENCE_TIMEOUT_NS
        )
        self._received_ns, self._unanswered = received_ns, False
        if silent:
            self.suspend()
        return silent

    def synchronised(self, samples: Sequence[ClockSample], now_ns: int) -> SynchronisationResult:
        """Take the samples of a synchronisation, at least one; held measurements are stamped and released."""
        newest = samples[-1]
        if self._received_ns is None or samples[0].sent_ns - self._received_ns > MIN_RESTART_NS:
            self._held_before_restart = bool(self._held)
        known = self.state is not ClockState.UNSYNCHRONISED
        suspended = self.state is ClockState.SUSPENDED
        forgotten = suspended and not self._agrees(newest)
        if forgotten:
            self._clock.reset()  # the paper's filter would only take a tenth of the step
        earlier_ns = self._earlier_offsets_ns() if known and not forgotten else {}
        updated = self._clock.update(samples, may_have_restarted=suspended)
        self._handle(ClockEvent.SYNCHRONISATION)
        self._received_ns, self._unanswered = now_ns, False
        other_clock = self._held_before_restart and (updated.restarted or not known)
        self._offset_ns = newest.station_ns - newest.sent_ns - newest.forward_ns
        # The first, rough offset gives the present on the station's clock.
        self._offset_ns = self._clock.at(now_ns + self._offset_ns).offset_ns
        estimate = self._at(now_ns + self._offset_ns)
        record = ClockRecord(
            stamp_ns=now_ns,
            station=self._station,
            filter=self._clock.name,
            offset_ns=estimate.offset_ns,
            frequency_ppm=estimate.skew_ppm,
            sigma_ns=estimate.sigma_ns,
            bound_ns=estimate.bound_ns,
            restarted=updated.restarted,
            samples=tuple(samples),
            rejected=updated.rejected,
        )
        released = [
            self._released(*held, None if other_clock else estimate, earlier_ns.get(held[0].time_ns))
            for held in self._held
        ]
        self._held.clear()
        self._held_before_restart = False
        return SynchronisationResult(
            record, [m for m in released if m is not None], updated.restarted and known
        )

    def _earlier_offsets_ns(self) -> dict[int, int]:
        """Return the offset in ns of each held measurement that may be of the clock before this synchronisation."""
        held = self._held if self._held_before_restart else ()
        return {message.time_ns: self._clock.at(message.time_ns).offset_ns for message, _ in held}

    def _agrees(self, sample: ClockSample) -> bool:
        """Whether a sample is consistent with the known clock."""
        estimate = self._at(sample.station_ns)
        lowest_ns = sample.min_offset_ns - estimate.bound_ns
        return lowest_ns <= estimate.offset_ns <= sample.max_offset_ns + estimate.bound_ns

    def clock(self, now_ns: int) -> ClockEstimate | None:
        """Return the estimate of the station's clock at an instant; None while unsynchronised."""
        return None if self.state is ClockState.UNSYNCHRONISED else self._at(now_ns + self._offset_ns)

    def _at(self, station_ns: int) -> ClockEstimate:
        estimate = self._clock.at(station_ns)
        return replace(estimate, bound_ns=estimate.bound_ns + self._stamp_delay_ns)

    def _untimed(self, message: MeasurementMessage, received_ns: int) -> PolarMeasurement | None:
        """Return an error without a valid time, once until something else arrives."""
        key = _Untimed(message.status)
        if key == self._last:
            return None
        self._last = key
        return self._record(message, received_ns, received_ns, UNTIMED_SIGMA_NS)

    def _released(
        self,
        message: MeasurementMessage,
        received_ns: int,
        present: ClockEstimate | None,
        earlier_ns: int | None,
    ) -> PolarMeasurement | None:
        """Stamp a held measurement unless it may be of the clock whose offset was ``earlier_ns``: steps may be small."""
        if present is not None:
            stamp_ns = message.time_ns - present.offset_ns
            if received_ns - 2 * STALE_THRESHOLD_NS <= stamp_ns <= received_ns + present.bound_ns:
                return self._measurement(message, received_ns, earlier_ns)
        if _timed(message):
            return None  # its time is unknown; the station's journal has it
        return self._record(message, received_ns, received_ns, UNTIMED_SIGMA_NS)

    def _measurement(
        self, message: MeasurementMessage, received_ns: int, earlier_ns: int | None = None
    ) -> PolarMeasurement:
        estimate = self._clock.at(message.time_ns)
        stepped_ns = 0 if earlier_ns is None else abs(estimate.offset_ns - earlier_ns)
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
    """Whether this is an error of an authors' node: -1 for all values, and a meaningless time."""
    return message.zenith_angle_rad < 0


def _timed(message: MeasurementMessage) -> bool:
    """Whether every node stamps it: an authors' node has no time for its errors."""
    return status_of(message) in (Status.OK, Status.ANGLE_ONLY)
