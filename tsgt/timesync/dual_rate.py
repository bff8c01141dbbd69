"""A segment of time in which a clock's skew wanders but does not break: two Kalman filters over its samples.

The *slow* filter assumes a steady skew, as of crystals in the field, and gives the value. The *fast* one trusts it for
seconds only: the truth stays within five of its standard errors, and the slow one's bound is its distance from there.
Where the two diverge the skew has changed, and the slow filter is reinitialised from the fast one.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from typing import NamedTuple

from tsgt.timesync.clock_line import ClockLine

_SLOW_WALK_PPM2_PER_S = 0.006
"""Skew random walk of the slow filter, 0.6 ppm in a minute: with a sample every 0.4 s it averages over 20 to 30 s."""

_FAST_WALK_PPM2_PER_S = 6.0  # that of the fast filter, 2.5 ppm in a second: it averages over about 3 s
_MAX_FAST_WALK_S = 10.0  # in a longer outage the fast skew walks no further: crystals do not

SIGMAS = 5.0  # the truth is within this many standard errors of the fast estimate

_MAX_SKEW_STEP_PPM = 25.0
_SKEW_STEP_S = 2.0
"""The skew may have stepped by this since the last sample; beyond this time the fast filter's walk covers it."""

_DIVERGENCE_SIGMAS = 3.0
"""The skew has changed when the estimates differ by more than this many standard errors of the fast one."""

_NIS_GAIN = 0.4
_USUAL_NIS = 2.0
_MAX_NIS = 25.0
"""Gain and cap of the averaged NIS. A mean NIS above the usual one inflates the fast filter's error and walk."""

_HORIZON_NS = 30_000_000_000
_MIN_LOOKAHEAD_NS = 20_000_000_000
"""How much later data the backward pass uses: more changes hardly anything and takes long."""


class BeaconSample(NamedTuple):
    """A beacon: when this computer received it, and when the master sent it.

    Attributes
    ----------
    received_ns, sent_ns
        On this computer's clock, and on the master's.
    sigma_ns
        Claimed one sigma of ``received_ns``.
    variance_us2
        Variance of their difference, in us^2.
    """

    received_ns: int
    sent_ns: int
    sigma_ns: int
    variance_us2: float


class DualEstimate(NamedTuple):
    """Both estimates at one instant, in us and ppm, and the averaged NIS of the fast filter, 1 or more."""

    slow: ClockLine
    fast: ClockLine
    nis: float = 1.0

    @property
    def _inflation(self) -> float:
        return max(self.nis - _USUAL_NIS + 1, 1.0)

    def offset_bound_us(self, near_s: float) -> float:
        """Return the bound of the slow offset; ``near_s`` is the distance to the nearest sample."""
        step_us = _MAX_SKEW_STEP_PPM * min(near_s, _SKEW_STEP_S)
        fast_us = SIGMAS * math.sqrt(self._inflation * self.fast.offset_variance) + step_us
        return fast_us + abs(self.slow.offset - self.fast.offset)

    def skew_bound_ppm(self) -> float:
        """Return the bound of the slow skew."""
        fast_ppm = SIGMAS * math.sqrt(self._inflation * self.fast.skew_variance) + _MAX_SKEW_STEP_PPM
        return fast_ppm + abs(self.slow.skew - self.fast.skew)

    def propagate(self, dt_s: float) -> DualEstimate:
        """Predict both estimates ``dt_s`` later; negative: earlier."""
        duration_s = abs(dt_s)
        fast_walk_ppm2 = _FAST_WALK_PPM2_PER_S * self._inflation**2 * min(duration_s, _MAX_FAST_WALK_S)
        return DualEstimate(
            self.slow.propagate(dt_s, _SLOW_WALK_PPM2_PER_S * duration_s),
            self.fast.propagate(dt_s, fast_walk_ppm2),
            self.nis,
        )


class ClockSegment:
    """Estimates the offset of the master's clock, ``sent_ns - received_ns``, from sample to sample.

    ``sample``: the first one. ``skew_ppm``, ``skew_sigma_ppm``: prior of the skew; positive: the master's clock runs
    faster than this one.
    """

    def __init__(self, sample: BeaconSample, skew_ppm: float, skew_sigma_ppm: float) -> None:
        self.base_ns = sample.sent_ns - sample.received_ns
        self._skew_sigma_ppm = skew_sigma_ppm
        start = ClockLine(0.0, skew_ppm, sample.variance_us2, 0.0, skew_sigma_ppm**2)
        self._samples = [sample]
        self._received_ns = [sample.received_ns]
        self._forward = [DualEstimate(start, start)]
        self._clear_backward()

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def first_ns(self) -> int:
        """Reception of the oldest sample."""
        return self._received_ns[0]

    @property
    def last_ns(self) -> int:
        """Reception of the newest sample."""
        return self._received_ns[-1]

    @property
    def skew_ppm(self) -> float:
        """Fast estimate of the skew at the newest sample."""
        return self._forward[-1].fast.skew

    def innovation_us(self, sample: BeaconSample) -> float:
        """Return the deviation of a new sample from the fast prediction."""
        return self._offset_us(sample) - self._predicted(sample).offset

    def is_consistent(self, sample: BeaconSample) -> bool:
        """Whether jitter and the wander of clocks can explain a new sample."""
        return abs(self.innovation_us(sample)) <= self._gate_us(sample, self._predicted(sample))

    def is_within_jitter(self, sample: BeaconSample) -> bool:
        """Whether jitter alone can explain a new sample, however old the last one is."""
        return abs(self.innovation_us(sample)) <= self._gate_us(sample, self._forward[-1].fast)

    def _gate_us(self, sample: BeaconSample, line: ClockLine) -> float:
        step_us = _MAX_SKEW_STEP_PPM * min(_seconds(sample.received_ns - self.last_ns), _SKEW_STEP_S)
        return SIGMAS * math.sqrt(line.offset_variance + sample.variance_us2) + step_us

    def add(self, sample: BeaconSample) -> None:
        """Append a sample that is newer than all others."""
        self._forward.append(self._step(self._forward[-1], self._samples[-1], sample))
        self._samples.append(sample)
        self._received_ns.append(sample.received_ns)

    def extend(self, other: ClockSegment) -> None:
        """Append the samples of another segment, all newer than all others."""
        for sample in other._samples:
            self.add(sample)

    def drop_oldest(self, count: int) -> None:
        """Remove the oldest samples; their information about later times stays."""
        del self._samples[:count], self._received_ns[:count], self._forward[:count]
        self._clear_backward()

    def at(self, local_ns: int) -> tuple[DualEstimate, float]:
        """Return the smoothed estimate at an instant of this computer's clock, and the distance of the nearest sample in s."""
        following = bisect_right(self._received_ns, local_ns)
        if following == len(self._samples):
            near_s = _seconds(local_ns - self.last_ns)
            return self._forward[-1].propagate(near_s), near_s
        until_s = _seconds(local_ns - self._received_ns[following])
        later = self._backward_at(following).propagate(until_s)
        if following == 0:
            return later, -until_s
        since_s = _seconds(local_ns - self._received_ns[following - 1])
        earlier = self._forward[following - 1].propagate(since_s)
        smoothed = DualEstimate(
            earlier.slow.fuse(later.slow), earlier.fast.fuse(later.fast), max(earlier.nis, later.nis)
        )
        return smoothed, min(since_s, -until_s)

    def _clear_backward(self) -> None:
        self._backward: dict[int, DualEstimate] = {}
        self._backward_first = self._backward_last = -1

    def _backward_at(self, index: int) -> DualEstimate:
        """Return the estimate at a sample from that sample and those after it, within the horizon."""
        samples, times, newest = self._samples, self._received_ns, len(self._samples) - 1
        first, last = self._backward_first, self._backward_last
        sufficient = first == newest or times[first] - times[index] >= _MIN_LOOKAHEAD_NS
        if index > first or not sufficient or times[last] - times[index] > _HORIZON_NS:
            start = min(bisect_left(times, times[index] + _HORIZON_NS), newest)
            skew_ppm = self._forward[start].slow.skew
            line = ClockLine(
                self._offset_us(samples[start]),
                skew_ppm,
                samples[start].variance_us2,
                0.0,
                self._skew_sigma_ppm**2,
            )
            self._backward = {start: DualEstimate(line, line)}
            self._backward_first = self._backward_last = start
        estimate = self._backward[self._backward_last]
        while self._backward_last > index:
            estimate = self._step(estimate, samples[self._backward_last], samples[self._backward_last - 1])
            self._backward_last -= 1
            self._backward[self._backward_last] = estimate
        return self._backward[index]

    def _step(self, estimate: DualEstimate, sample: BeaconSample, following: BeaconSample) -> DualEstimate:
        """Propagate from a sample to the following one, forwards or backwards in time, and update."""
        slow, fast, nis = estimate.propagate(_seconds(following.received_ns - sample.received_ns))
        offset_us, variance = self._offset_us(following), following.variance_us2
        sample_nis = (offset_us - fast.offset) ** 2 / (fast.offset_variance + variance)
        nis += _NIS_GAIN * (min(sample_nis, _MAX_NIS) - nis)
        slow, fast = slow.update(offset_us, variance), fast.update(offset_us, variance)
        diverged = (slow.offset - fast.offset) ** 2 > _DIVERGENCE_SIGMAS**2 * fast.offset_variance
        return DualEstimate(fast if diverged else slow, fast, nis)

    def _predicted(self, sample: BeaconSample) -> ClockLine:
        return self._forward[-1].propagate(_seconds(sample.received_ns - self.last_ns)).fast

    def _offset_us(self, sample: BeaconSample) -> float:
        return (sample.sent_ns - sample.received_ns - self.base_ns) / 1000


def _seconds(duration_ns: int) -> float:
    return duration_ns / 1e9
