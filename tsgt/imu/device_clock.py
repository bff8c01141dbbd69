"""The clock of the device on the host's CLOCK_MONOTONIC, from the arrival of its samples. Sans-I/O.

A sample arrives after a delay that varies above a minimum, so that "arrival less device time" lies above a line, the lower
envelope. Only the fastest samples shape it: a burst that arrives late changes nothing. None can arrive early: samples
below the envelope mean that the device's clock was set. Where it was set back by little, or the host's was slewed by NTP, all
samples of some seconds are late by the same.

The skew of a crystal is below 0.1 %, so that some samples tell the time. A clock whose samples show more, that of a ceramic
resonator, has the bounds of a counter, 5 %. One beyond these is no clock: it is never initialised.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from tsgt.timesync import fit_lower_envelope

WINDOW_NS = 60e9
_BIN_NS = 0.1e9
"""Of each bin the fastest sample is kept. Over a longer window the envelope is no line: a crystal's rate follows its
temperature."""

MIN_SAMPLES = 8

INITIAL_NS = 500_000_000
"""Samples of this long, on both clocks, give the first times. Old samples in a buffer arrive within an instant, and do not."""

_MAX_SKEW = 1e-3
_SKEW_SIGMA = 1e-4
_COUNTER_INITIAL_NS = 4 * INITIAL_NS
_MAX_COUNTER_SKEW = 0.05
_COUNTER_SKEW_SIGMA = 0.02
"""Bound and sigma of the skew before it was measured: of a clock, and of a counter times its nominal period."""

_CERTAIN_SIGMAS = 5.0
_EVIDENCE_NS = 1e9
"""A clock has the bounds of a counter once its skew has exceeded its own by so many sigmas, for so long after the first fit."""

_MIN_SCALE_NS = 2_000.0  # jitter of the arrival itself
_DELAY_CAP = 4.0  # a delay counts as at most this many mean delays: a stall says nothing about the others

STEP_NS = 3_000_000
"""A sample this far below the envelope is not a faster one."""

_LATE_NS, _MIN_LATE_BINS = 8e9, 15
_LATE_SPREAD_NS = 4_000_000
"""All samples are late when the fastest ones of both halves of this time lie :data:`STEP_NS` above the envelope, beyond the mean delay, and
one from the other no farther than this, by which a clock that is slewed moves at most. Delays scatter, those of a stall become shorter, and a
computer is seldom busy for so long.
"""

_CANDIDATES = 3  # this many in a row replace the envelope

_REFIT_NS = 1e9
_REFIT_LOWER_NS = 0.1e9
"""Time between two fits, and the shortest one after a faster sample."""

_SLEW = 1e-3
_MAX_SLEWED_NS = 5e6
"""Times follow a new fit at this rate, so that samples that follow each other stay so; larger corrections are made at once."""


@dataclass(slots=True)
class _Bin:
    """The fastest sample of a bin, and sums over all."""

    number: int
    x: float
    y: float
    count: int = 0
    sum_x: float = 0.0
    sum_y: float = 0.0


class DeviceClock:
    """Fits the lower envelope of one device.

    ``counter``: the device's times are counts times the nominal period, whose rate may be off by percents. ``steps``: how
    often samples below the envelope, or above it all the time, have replaced it.
    """

    def __init__(self, *, counter: bool = False) -> None:
        self._max_skew, self._skew_sigma = _MAX_SKEW, _SKEW_SIGMA
        self._initial_ns = INITIAL_NS
        if counter:
            self._widen()
        self._skew = 0.0
        self.steps = 0
        self.reset()

    def reset(self) -> None:
        """Forget all samples, because the device's times have another origin now; the skew stays as a first value."""
        self._initial: list[tuple[int, int]] = []
        self._bins: deque[_Bin] = deque()
        self._x0 = self._y0 = 0
        self._height = self._mean_delay = 0.0
        self._fitted_x = self._correction = self._stamped_x = 0.0
        self._early: list[tuple[int, int]] = []
        self._beyond_from = math.inf
        self.initialised = False

    @property
    def started(self) -> bool:
        """Whether there was a sample since the last reset."""
        return self.initialised or bool(self._initial)

    @property
    def skew_ppm(self) -> float:
        """Skew of the host's clock against the device's; positive: the host's runs faster."""
        return self._skew * 1e6

    @property
    def rate(self) -> float:
        """Host time per device time."""
        return 1.0 + self._skew

    def add(self, device_ns: int, arrived_ns: int) -> bool:
        """Take the time of a sample and its arrival. Returns False if it lies so far below the envelope that it is not used."""
        if not self.initialised:
            self._initial.append((device_ns, arrived_ns))
            first_ns, first_arrived_ns = self._initial[0]
            spans_ns = (device_ns - first_ns, arrived_ns - first_arrived_ns)
            if len(self._initial) >= MIN_SAMPLES and min(spans_ns) >= self._initial_ns:
                self._initialise()
            return True
        x, y = self._coordinates(device_ns, arrived_ns)
        above = y - self._line(x)
        if above < -STEP_NS:
            self._early.append((device_ns, arrived_ns))
            if len(self._early) < _CANDIDATES:
                return False
            early = self._early
            self.reset()
            self._initial = early
            self.steps += 1
            return True
        self._early.clear()
        self._put(x, y)
        if x - self._fitted_x > (_REFIT_LOWER_NS if above < 0 else _REFIT_NS):
            before = self._line(x)
            self._fit()
            if self._are_late:
                while self._bins[0].x < x - _LATE_NS:
                    self._bins.popleft()
                self._fit()
                self.steps += abs(before - self._line(x)) > _MAX_SLEWED_NS
            self._correction += before - self._line(x)
            self._fitted_x = x
            if self._is_no_clock:
                self._begin_again((device_ns, arrived_ns))
        return True

    def stamp(self, device_ns: int) -> int:
        """Return the arrival of an infinitely fast sample of this device time; call it with each time in turn."""
        x = float(device_ns - self._x0)
        if abs(self._correction) > _MAX_SLEWED_NS:
            self._correction = 0.0
        slewed = _SLEW * max(x - self._stamped_x, 0.0)
        self._correction = math.copysign(max(abs(self._correction) - slewed, 0.0), self._correction)
        self._stamped_x = x
        return self._x0 + self._y0 + round(x + self._line(x) + self._correction)

    def _line(self, x: float) -> float:
        return self._height + self._skew * x

    def _coordinates(self, device_ns: int, arrived_ns: int) -> tuple[float, float]:
        """Return device time, and arrival less device time, from the origin of this fit."""
        x = device_ns - self._x0
        return float(x), float(arrived_ns - self._y0 - self._x0 - x)

    def _initialise(self) -> None:
        """Fit the first samples, all of them, because the skew may be unknown and each bin's fastest one with it."""
        first_ns, first_arrived_ns = self._initial[0]
        self._x0, self._y0 = first_ns, first_arrived_ns - first_ns
        points = [self._coordinates(*sample) for sample in self._initial]
        lowest = min(y - self._skew * x for x, y in points)
        self._mean_delay = sum(y - self._skew * x for x, y in points) / len(points) - lowest
        centre = sum(x for x, _ in points) / len(points)
        if not self._wide and (line := self._line_beyond(points, centre, len(points))) is not None:
            if self._initial_ns < _COUNTER_INITIAL_NS:  # More samples tell whether these were late by chance
                self._initial_ns = _COUNTER_INITIAL_NS
                return
            if not _reaches(line, points):
                self._begin_again(self._initial[-1])
                return
            self._widen()
        self._solve(points, centre, len(points))
        for x, y in points:
            self._put(x, y)
        self._fit()
        if self._is_no_clock:
            self._begin_again(self._initial[-1])
            return
        self._initial = []
        self._fitted_x = self._stamped_x = points[-1][0]
        self.initialised = True

    @property
    def _wide(self) -> bool:
        return self._max_skew == _MAX_COUNTER_SKEW

    def _widen(self) -> None:
        """Take the bounds of a counter."""
        self._max_skew, self._skew_sigma = _MAX_COUNTER_SKEW, _COUNTER_SKEW_SIGMA
        self._initial_ns = _COUNTER_INITIAL_NS

    @property
    def _is_no_clock(self) -> bool:
        """Whether the skew is at the widest bound, or beyond: the samples lie on no line that is possible."""
        return abs(self._skew) >= 0.999 * _MAX_COUNTER_SKEW

    def _begin_again(self, sample: tuple[int, int]) -> None:
        self.reset()
        self._skew, self._initial = 0.0, [sample]

    def _put(self, x: float, y: float) -> None:
        """Put a sample into its bin."""
        number = math.floor(x / _BIN_NS)
        if not self._bins or number > self._bins[-1].number:
            self._bins.append(_Bin(number, x, y))
            while self._bins[0].x < x - WINDOW_NS:
                self._bins.popleft()
        newest = self._bins[-1]
        if y - self._skew * x < newest.y - self._skew * newest.x:
            newest.x, newest.y = x, y
        newest.count += 1
        newest.sum_x += x
        newest.sum_y += min(y, self._line(x) + _DELAY_CAP * max(self._mean_delay, _MIN_SCALE_NS))

    def _fit(self) -> None:
        """Fit the envelope to the fastest sample of each bin."""
        bins = self._bins
        samples = sum(each.count for each in bins)
        mean = (sum(each.sum_x for each in bins) / samples, sum(each.sum_y for each in bins) / samples)
        points = [(each.x, each.y) for each in bins]
        lowest = min(y - self._skew * x for x, y in points)
        self._mean_delay = mean[1] - self._skew * mean[0] - lowest
        self._solve(points, mean[0], samples)
        if not self._wide and self._has_shown_more(points, mean[0], samples):
            self._widen()
            self._solve(points, mean[0], samples)

    @property
    def _are_late(self) -> bool:
        """Whether the newest samples are late by the same, so that the samples before tell another time."""
        newest = self._bins[-1].x
        middle = newest - _LATE_NS / 2
        if self._bins[0].x > newest - _LATE_NS:
            return False
        recent = [each for each in self._bins if each.x > newest - _LATE_NS]
        halves = [each for each in recent if each.x <= middle], [each for each in recent if each.x > middle]
        if min(map(len, halves)) < _MIN_LATE_BINS:
            return False
        first, second = (min(each.y - self._line(each.x) for each in half) for half in halves)
        return min(first, second) > max(STEP_NS, self._mean_delay) and abs(first - second) < _LATE_SPREAD_NS

    def _has_shown_more(self, points: list[tuple[float, float]], centre: float, samples: int) -> bool:
        """Whether fits of some seconds have shown a skew beyond the bound of a clock."""
        line = self._line_beyond(points, centre, samples)
        if line is None or not _reaches(line, points):
            self._beyond_from = math.inf
            return False
        now = sum(points[-1])  # Of arrival: late samples arrive at once
        self._beyond_from = min(self._beyond_from, now)
        return now - self._beyond_from >= _EVIDENCE_NS

    def _line_beyond(
        self, points: list[tuple[float, float]], centre: float, samples: int
    ) -> tuple[float, float] | None:
        """Return height and slope of the line by points alone, if its skew is certainly beyond the bound of a clock."""
        line = fit_lower_envelope(
            points,
            centre=centre,
            scale=self._scale(samples),
            prior=(0.0, _COUNTER_SKEW_SIGMA),
            max_slope=_MAX_COUNTER_SKEW,
        )
        if abs(line.slope) - _CERTAIN_SIGMAS * line.slope_sigma <= _MAX_SKEW:
            return None
        return line.height, line.slope

    def _scale(self, samples: int) -> float:
        return max(self._mean_delay / samples, _MIN_SCALE_NS)

    def _solve(self, points: list[tuple[float, float]], centre: float, samples: int) -> None:
        scale = self._scale(samples)
        line = fit_lower_envelope(
            points, centre=centre, scale=scale, prior=(0.0, self._skew_sigma), max_slope=self._max_skew
        )
        # Once more about this slope: the grid over all slopes is too coarse for the skew of a counter.
        slope = line.slope
        relative = [(x, y - slope * x) for x, y in points]
        fine = fit_lower_envelope(
            relative,
            centre=centre,
            scale=scale,
            prior=(-slope, self._skew_sigma),
            max_slope=self._max_skew / 100,
        )
        self._height, self._skew = fine.height, slope + fine.slope


def _reaches(line: tuple[float, float], points: list[tuple[float, float]]) -> bool:
    """Whether newest points are near a line: a stall that is being caught up leaves all of them far above any."""
    height, slope = line
    newest = [y - slope * x for x, y in points if x > points[-1][0] - INITIAL_NS / 2]
    return min(newest) - height < STEP_NS
