"""The master's session time on a station's clock, from the beacons that the station receives.

Each beacon states when the previous one was sent. So every received beacon that is followed by another makes a sample:
its reception on the station's CLOCK_MONOTONIC, and the session time at which the master sent it. The time between the
two, the link delay, is constant; the master adds it. docs/explanation/superframe-clock.md explains the fit and its bound.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from typing import NamedTuple

from tsgt.timesync.dual_rate import BeaconSample, ClockSegment

SENDER_SIGMA_NS = 20_000
COARSE_SENDER_SIGMA_NS = 1_000_000
"""Sigma of the master's timestamp, which no beacon states: the coarse one until enough samples show their jitter."""

MAX_SKEW_PPM = 120.0  # bound of the skew between two computers' clocks before it is measured

MAX_DEVIATION_US = 200.0  # a sample that deviates by more than this, and by more than the gate, is rejected

_SKEW_SIGMA_PPM = 30.0  # prior of the skew of a new clock,
_SLEWED_SIGMA_PPM = 200.0  # and of one that has just been slewed

_MIN_CANDIDATE_SAMPLES = 5
"""This many consecutive samples that agree with each other start a new segment against the current one."""

MAX_SAMPLES = 10_000  # an hour and more at the usual rate
_DROPPED_SAMPLES = 1_000  # how many are dropped at a time

_MAX_UNWRAP_BOUND_US = 30_000.0
"""The 16 low bits of a time are unambiguous within half of 2^16 us, less a margin."""
_STAMP_BOUND_SIGMAS = 2.0
"""Of a time stamp of tens of milliseconds: it is uniform over the interval at which the chip was polled, 3.5 sigmas."""
_WRAP_US = 65_536.0
_MAX_UNWRAPPED_JUMP_US = 5_000.0
"""An offset that seems to have jumped by more than this may have jumped by 2^16 us more."""

_MIN_INITIAL_SAMPLES = 2
"""One beacon can be delayed by any time; two in a row by the same delay are too unlikely."""


class TimeEstimate(NamedTuple):
    """A time on the master's clock, or a duration.

    Attributes
    ----------
    time_us
        Session time without the link delay.
    sigma_us
        One sigma from jitter and the wander of a usual crystal.
    bound_us
        The truth is within this of ``time_us``.
    """

    time_us: float
    sigma_us: float
    bound_us: float


class _EarlySample(NamedTuple):
    """A sample from before the jitter was known."""

    sample: BeaconSample
    unambiguous: bool
    live: bool


class _Jitter:
    """Scale of the scatter over the claimed sigma: a running mean square with a prior and exponential forgetting."""

    _MIN_SAMPLES = 8
    _SMALL_SAMPLE_INFLATION = 16
    _PRIOR = 1.5
    _PRIOR_WEIGHT = 4.0
    _MEMORY_SAMPLES = 60.0
    _MIN_SCALE = 0.1

    _MAX_SQUARE = 1_000.0
    """Cap of one sample's weighted square: an outlier is no jitter. Where all are large the cap rises with each."""

    _MAX_SPAN_NS = 15_000_000_000
    """Between neighbours further apart a clock may wander by as much as timestamps scatter."""

    def __init__(self) -> None:
        self._weight = self._PRIOR_WEIGHT
        self._square = self._PRIOR**2
        self._seen = 0
        self._last: deque[tuple[int, int, float]] = deque(maxlen=3)

    @property
    def known(self) -> bool:
        """Whether there were enough samples."""
        return self._seen >= self._MIN_SAMPLES

    def variance_us2(self, sigma_ns: int) -> float:
        """Return the variance of a sample whose reception claims this sigma; never less than claimed."""
        if not self.known:
            return (sigma_ns**2 + COARSE_SENDER_SIGMA_NS**2) / 1e6
        square = self._square * (1 + self._SMALL_SAMPLE_INFLATION / self._seen)
        return max(square * _claimed_us2(sigma_ns), sigma_ns**2 / 1e6, 1.0)

    def add(self, sample: BeaconSample) -> None:
        """Take the newest sample, which completes the neighbourhood of the one before it."""
        offset_ns = sample.sent_ns - sample.received_ns
        self._last.append((sample.received_ns, offset_ns, _claimed_us2(sample.sigma_ns)))
        if len(self._last) < 3:
            return
        (t0, y0, v0), (t1, y1, v1), (t2, y2, v2) = self._last
        if t2 - t0 > self._MAX_SPAN_NS:
            return
        share = (t1 - t0) / (t2 - t0)
        deviation_us = (y1 - y0 - share * (y2 - y0)) / 1000
        expected = v1 + (1 - share) ** 2 * v0 + share**2 * v2
        square = min(deviation_us**2 / expected, self._MAX_SQUARE / self._weight * self._square)
        self._seen += 1
        self._weight = min(self._weight + 1, self._MEMORY_SAMPLES)
        self._square += (square - self._square) / self._weight
        self._square = max(self._square, self._MIN_SCALE**2)


class BeaconClock:
    """Estimates the master's session time on a station's clock; one for each session of the master.

    ``initialised``: two unambiguous samples have agreed, one of them live; before that there is no time.
    """

    def __init__(self) -> None:
        self._jitter = _Jitter()
        self._early: deque[_EarlySample] = deque(maxlen=MAX_SAMPLES)
        self._segments: list[ClockSegment] = []
        self._initial_live = False
        self.initialised = False
        self._candidate: ClockSegment | None = None
        self._candidate_unambiguous = False  # a live sample stated its time to 2^40 us, not only to 2^16
        self._candidate_live = False
        self._candidate_consistent = False  # with the fit, but only because of a long outage

    @property
    def first_received_ns(self) -> int | None:
        """Reception of the oldest sample."""
        return self._segments[0].first_ns if self._segments else None

    @property
    def last_received_ns(self) -> int | None:
        """Reception of the newest sample of the fit."""
        return self._segments[-1].last_ns if self._segments else None

    @property
    def samples(self) -> int:
        """Number of samples that the fit rests on."""
        return sum(map(len, self._segments))

    @property
    def converged(self) -> bool:
        """Whether enough samples agree that delayed beacons would have been outvoted."""
        return self.initialised and len(self._segments[-1]) >= _MIN_CANDIDATE_SAMPLES

    def add(
        self, received_ns: int, sent_us: int, sigma_ns: int, *, unambiguous: bool = False, live: bool = True
    ) -> bool:
        """Take a sample, in the order of reception.

        A rejected sample does not change the fit, but the bound contains it until a consistent one follows. Five in a
        row that agree with each other start a new segment, if one of them was live; beyond a jump of 5 ms a live one
        must be unambiguous. Before initialisation only unambiguous samples are taken, and of two that disagree the
        newer one is kept. A sample that is consistent only because of a long outage waits outside the fit, too, until
        five agree with each other. Returns False if rejected: it deviates by more than 200 us, and by more than jitter
        and wander explain: the beacon was delayed, or the clock was set.

        Parameters
        ----------
        received_ns
            On this computer's clock.
        sent_us
            Session time at which the beacon was sent.
        sigma_ns
            One sigma of ``received_ns``, as the radio claims it.
        unambiguous
            The session time is from a session item, and not from :meth:`unwrap`.
        live
            The master has received the response to this beacon, so it was not replayed.
        """
        sent_ns = 1000 * sent_us
        newest_ns = self._candidate.last_ns if self._candidate else self.last_received_ns
        if newest_ns is not None and received_ns <= newest_ns:
            return False
        sample = BeaconSample(received_ns, sent_ns, sigma_ns, self._jitter.variance_us2(sigma_ns))
        if not self.initialised:
            return unambiguous and self._initialise(sample, live=live)
        jitter_unknown = not self._jitter.known
        consistent = self._segments[-1].is_consistent(sample)
        if consistent or self._candidate is not None:
            self._jitter.add(sample)  # a single outlier says nothing about the jitter of the others
        if jitter_unknown:
            self._early.append(_EarlySample(sample, unambiguous or consistent, live))
            if self._jitter.known:
                return self._refit()
        return self._fit(sample, unambiguous=unambiguous, live=live)

    def _fit(self, sample: BeaconSample, *, unambiguous: bool, live: bool) -> bool:
        """Take a sample after initialisation; return False if rejected."""
        segment = self._segments[-1]
        if not segment.is_consistent(sample):
            self._add_to_candidate(sample, segment, unambiguous=unambiguous, live=live)
            return abs(segment.innovation_us(sample)) <= MAX_DEVIATION_US
        if self._must_wait(sample, segment, live=live):
            return True
        segment.add(sample)
        self._candidate = None
        self._limit_samples()
        return True

    def _refit(self) -> bool:
        """Take all samples anew with the jitter that is now known; return False if the newest is rejected.

        Some of them may share a delay that the coarse variances accepted.
        """
        early = list(self._early)
        self._early.clear()
        self._segments, self._candidate, self.initialised = [], None, False
        accepted = False
        for sample, unambiguous, live in early:
            weighted = sample._replace(variance_us2=self._jitter.variance_us2(sample.sigma_ns))
            if self.initialised:
                accepted = self._fit(weighted, unambiguous=unambiguous, live=live)
            else:
                accepted = unambiguous and self._add_initial(weighted, live=live)
        return accepted

    def unwrap(self, received_ns: int, low16: int, sigma_ns: int) -> int | None:
        """Return the full session time in us of a beacon, from its 16 low bits; None where it is ambiguous.

        ``sigma_ns``: one sigma of ``received_ns``. Of a reception that was noticed late, by polling, it is tens of milliseconds.
        """
        if not self.initialised:
            return None
        candidate = self._candidate
        # A single delayed beacon must not keep the next ones from being decoded.
        segment = candidate if candidate and self._candidate_unambiguous else self._segments[-1]
        predicted = _time_in(segment, received_ns)
        if predicted.bound_us + _STAMP_BOUND_SIGMAS * sigma_ns / 1000 > _MAX_UNWRAP_BOUND_US:
            return None
        predicted_us = round(predicted.time_us)
        return predicted_us + (low16 - predicted_us + 0x8000) % 0x10000 - 0x8000

    def at(self, local_ns: int) -> TimeEstimate | None:
        """Return the session time at an instant of this computer's clock, also beyond the samples; None before initialisation."""
        return self._at(local_ns) if self.initialised else None

    def elapsed(self, from_ns: int, to_ns: int) -> TimeEstimate:
        """Return the master's duration between two local instants; before initialisation within the skew's bound."""
        local_us = (to_ns - from_ns) / 1000
        if not self.initialised:
            return _duration(local_us, 0.0, _SKEW_SIGMA_PPM, MAX_SKEW_PPM)
        start, end = self._at(from_ns), self._at(to_ns)
        by_ends = TimeEstimate(
            end.time_us - start.time_us,
            math.hypot(start.sigma_us, end.sigma_us),
            start.bound_us + end.bound_us,
        )
        earlier_ns, later_ns = min(from_ns, to_ns), max(from_ns, to_ns)
        index = self._index(earlier_ns)
        segment = self._segments[index]
        newest = index == len(self._segments) - 1
        if later_ns > segment.last_ns and not newest:
            return by_ends  # the skew has changed in between
        estimate, _ = segment.at((from_ns + to_ns) // 2)
        bound_ppm = estimate.skew_bound_ppm()
        if self._candidate is not None and newest and later_ns > segment.last_ns:
            bound_ppm += self._deviation_bound_us(self._candidate) / (
                (self._candidate.first_ns - segment.last_ns) / 1e9
            )
        by_skew = _duration(local_us, estimate.slow.skew, math.sqrt(estimate.slow.skew_variance), bound_ppm)
        return by_ends if by_ends.bound_us < by_skew.bound_us else by_skew

    def _at(self, local_ns: int) -> TimeEstimate:
        index = self._index(local_ns)
        segment = self._segments[index]
        time = _time_in(segment, local_ns)
        unconfirmed = len(segment) < _MIN_CANDIDATE_SAMPLES  # may be wrong from its first sample on
        if local_ns <= segment.last_ns and not unconfirmed:
            return time
        if index + 1 < len(self._segments):
            # Somewhere between the two segments the clock was set.
            return _either(time, _time_in(self._segments[index + 1], local_ns))
        if self._candidate is None:
            return time
        # The skew may have changed right after the last sample.
        share = (local_ns - segment.last_ns) / (self._candidate.first_ns - segment.last_ns)
        share = max(share, 1.0) if unconfirmed else share
        return time._replace(bound_us=time.bound_us + self._deviation_bound_us(self._candidate) * share)

    def _index(self, local_ns: int) -> int:
        """Return the segment of an instant; one between two segments belongs to the earlier one."""
        return max(bisect_right(self._segments, local_ns, key=lambda segment: segment.first_ns) - 1, 0)

    def _initialise(self, sample: BeaconSample, *, live: bool) -> bool:
        """Take an unambiguous sample before initialisation; return whether it agrees with those before it."""
        if self._segments and not self._segments[0].is_consistent(sample):
            self._jitter = _Jitter()
            self._early.clear()
        self._jitter.add(sample)
        self._early.append(_EarlySample(sample, unambiguous=True, live=live))
        return self._add_initial(sample, live=live)

    def _add_initial(self, sample: BeaconSample, *, live: bool) -> bool:
        """Add a sample to the first segment, or start it with this one where they disagree."""
        first = not self._segments
        consistent = not first and self._segments[0].is_consistent(sample)
        if consistent:
            self._segments[0].add(sample)
        else:
            self._segments, self._initial_live = [ClockSegment(sample, 0.0, _SKEW_SIGMA_PPM)], False
        self._initial_live = self._initial_live or live
        self.initialised = self._initial_live and len(self._segments[0]) >= _MIN_INITIAL_SAMPLES
        return consistent or first

    def _add_to_candidate(
        self, sample: BeaconSample, segment: ClockSegment, *, unambiguous: bool, live: bool
    ) -> None:
        """Collect inconsistent samples that agree with each other, and start a new segment when they suffice."""
        candidate = self._candidate
        if candidate is None or not candidate.is_consistent(sample):
            self._candidate = ClockSegment(sample, segment.skew_ppm, _SLEWED_SIGMA_PPM)
            self._candidate_consistent = False
            self._candidate_unambiguous, self._candidate_live = unambiguous and live, live
            return
        candidate.add(sample)
        self._candidate_unambiguous = self._candidate_unambiguous or (unambiguous and live)
        self._candidate_live = self._candidate_live or live
        sufficient = self._candidate_live and len(candidate) >= _MIN_CANDIDATE_SAMPLES
        if sufficient and self._is_unwrapped(candidate):
            self._segments.append(candidate)
            self._candidate = None

    def _must_wait(self, sample: BeaconSample, segment: ClockSegment, *, live: bool) -> bool:
        """Whether a consistent sample waits for others: after an outage a single one may be delayed, and would decide."""
        waiting = self._candidate if self._candidate_consistent else None
        if waiting is not None and _is_near(waiting, sample):
            if len(waiting) + 1 >= _MIN_CANDIDATE_SAMPLES:
                segment.extend(waiting)
                return False
            waiting.add(sample)
            return True
        if _is_near(segment, sample):
            return False
        skew_ppm = segment.skew_ppm
        if waiting is not None and waiting.is_consistent(sample):
            waiting.add(sample)
            skew_ppm = waiting.skew_ppm
        self._candidate = ClockSegment(sample, skew_ppm, _SLEWED_SIGMA_PPM)
        self._candidate_consistent = True
        # A consistent sample is unambiguous by its low bits.
        self._candidate_unambiguous, self._candidate_live = True, live
        return True

    def _deviation_us(self, candidate: ClockSegment) -> float:
        """Return the deviation of a candidate's first sample from the fit."""
        segment = self._segments[-1]
        estimate, _ = segment.at(candidate.first_ns)
        return (candidate.base_ns - segment.base_ns) / 1000 - estimate.slow.offset

    def _is_unwrapped(self, candidate: ClockSegment) -> bool:
        """Whether the multiple of 2^16 us in the candidate's times is certain."""
        return self._candidate_unambiguous or abs(self._deviation_us(candidate)) <= _MAX_UNWRAPPED_JUMP_US

    def _deviation_bound_us(self, candidate: ClockSegment) -> float:
        """Return the error of the fit if the candidate is right."""
        return abs(self._deviation_us(candidate)) + (0.0 if self._is_unwrapped(candidate) else _WRAP_US)

    def _limit_samples(self) -> None:
        if self.samples <= MAX_SAMPLES:
            return
        oldest = self._segments[0]
        if len(oldest) > _DROPPED_SAMPLES:
            oldest.drop_oldest(_DROPPED_SAMPLES)
        else:
            del self._segments[0]


def _is_near(segment: ClockSegment, sample: BeaconSample) -> bool:
    """Whether jitter explains a sample, or it deviates by no more than the tolerance."""
    return segment.is_within_jitter(sample) or abs(segment.innovation_us(sample)) <= MAX_DEVIATION_US


def _time_in(segment: ClockSegment, local_ns: int) -> TimeEstimate:
    estimate, near_s = segment.at(local_ns)
    return TimeEstimate(
        (local_ns + segment.base_ns) / 1000 + estimate.slow.offset,
        math.sqrt(estimate.slow.offset_variance),
        estimate.offset_bound_us(near_s),
    )


def _either(one: TimeEstimate, other: TimeEstimate) -> TimeEstimate:
    """Return the midpoint of two estimates with a bound that contains both."""
    difference_us = abs(one.time_us - other.time_us)
    return TimeEstimate(
        (one.time_us + other.time_us) / 2,
        max(one.sigma_us, other.sigma_us) + difference_us / 2,
        max(one.bound_us, other.bound_us) + difference_us,
    )


def _duration(local_us: float, skew_ppm: float, sigma_ppm: float, bound_ppm: float) -> TimeEstimate:
    scale = abs(local_us) / 1e6
    return TimeEstimate(local_us + local_us * skew_ppm / 1e6, scale * sigma_ppm, scale * bound_ppm)


def _claimed_us2(sigma_ns: int) -> float:
    return (sigma_ns**2 + SENDER_SIGMA_NS**2) / 1e6
