"""The instrument's own time on the host's clock, from the arrival of its responses.

A response carries a time in ms since the instrument was switched on, and arrives after a delay that varies above a minimum.
So "arrival less instrument time" lies above a line, the lower envelope: its height is the clock offset plus the minimum
delay, its slope the skew. docs/explanation/instrument-time.md states errors and what is unobservable.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from tsgt.timesync.envelope import MinimumDelay, fit_lower_envelope, minimum_delay

MIN_SAMPLES = 8

MAX_DELAY_NS = 2_000_000_000
"""A response further above the envelope than this is not late: a clock has jumped."""

_WINDOW_NS = 300e9
_BIN_NS = 2e9
"""Of each bin the lowest sample is kept. A crystal in the sun changes its rate by 1e-6 in some minutes: over a longer
window the envelope is no line."""

_MIN_KEPT_SAMPLES = 30  # number of samples that are kept regardless of their age

_STEADY_NS = 120e9  # a skew from a longer span than this is kept over a power cycle

_MAX_SKEW = 300e-6
_UNKNOWN_SKEW_SIGMA = 60e-6
_KNOWN_SKEW_SIGMA = 5e-6
_SKEW_WANDER = 1e-6
"""Bound of the skew, its sigma before and after it was measured, and its wander within the window."""

_RESOLUTION_NS = 1e6
_ROUNDING_NS = 0.3e6
"""Instruments state their time in whole ms. Whether they round or truncate is unknown, and cancels: what is added to a
stated time is missing in the height of the envelope."""

_REFIT_GROWTH = 1.05  # refit without other news when the number of samples has grown by this factor

_MIN_DELAY_SHARE = 0.01
_DELAY_CAP = 4.0  # a delay counts as at most this many mean delays: a stall says nothing about the others

_SLOW_SHARE = 0.75
_SLOW_EXCHANGES = 4
_MIN_TIMED = 20
"""An exchange is slow if it takes longer than the fastest one, plus this share of what they take longer on average. After
this many in succession the instrument has become slower. Then a sample bounds the envelope, but does not count in the fit:
delays that grow would pass for a skew. The average is known from this many exchanges on."""

_FASTER_TOLERANCE_NS = 5e6
"""A sample below the others is one of a faster response, and no corrupted one, if its exchange took less than theirs by as much,
within this."""

_CANDIDATES = 3
_CANDIDATE_SPREAD_NS = 100e6
_CANDIDATE_WINDOW = 32
"""This many inconsistent samples within this spread, in a window of this many samples, replace the envelope."""


class HostTime(NamedTuple):
    """An instant on the host's CLOCK_MONOTONIC, plus the minimum delay, on whose constancy the bound depends."""

    host_ns: int
    sigma_ns: int
    bound_ns: int


@dataclass(slots=True)
class _Sample:
    """The time of a response before initialisation."""

    instrument_ms: int
    arrived_ns: int
    took_ns: int | None  # from the request to the arrival; None: unknown

    @property
    def offset_ns(self) -> int:
        """Arrival less instrument time."""
        return self.arrived_ns - self.instrument_ms * 1_000_000


@dataclass(slots=True)
class _Bin:
    """Two seconds of samples: the lowest one, sums over those that count, and over the exchanges of known duration among them."""

    number: int
    x: float
    y: float
    count: int = 0  # of all
    counted: int = 0
    sum_x: float = 0.0
    sum_y: float = 0.0
    timed: int = 0
    sum_took: float = 0.0
    min_took: float = math.inf


class InstrumentClock:
    """Fits the lower envelope of one instrument.

    A sample far from the envelope is inconsistent: it is used only when others agree with it. If these are too far off
    for any delay, the instrument was switched off and on or its count has jumped, and the fit is reset. ``resets``: how
    often the instrument's count has restarted. ``inconsistent``: whether the last sample, or distance, is inconsistent
    with the envelope.
    """

    def __init__(self) -> None:
        self._whole_ms = True
        self._known_skew = 0.0  # host against instrument; survives a power cycle
        self._known_sigma = _UNKNOWN_SKEW_SIGMA
        self._seen = 0
        self.resets = 0
        self.inconsistent = False
        self._reset([])

    def _reset(self, samples: list[_Sample]) -> None:
        self._initial = samples
        self._bins: deque[_Bin] = deque()
        self._x0 = self._y0 = 0
        self._height = self._skew = self._lift = 0.0
        self._mean_delay = self._excess = self._sigma = 0.0
        self._skew_sigma = self._known_sigma
        self._newest = self._pivot = 0.0
        self._samples = self._counted = self._fitted = 0
        self._slow = 0  # how many of the last exchanges were slow
        self._candidates: deque[tuple[int, int, int]] = deque(maxlen=_CANDIDATES)

    @property
    def initialised(self) -> bool:
        """Whether there were enough samples for times."""
        return self._samples > 0

    @property
    def samples(self) -> int:
        """How many samples the envelope rests on."""
        return self._samples

    @property
    def sigma_ns(self) -> float:
        """One sigma of the newest times; infinite before initialisation."""
        drift = self._skew_sigma * abs(self._newest - self._pivot)
        return math.hypot(self._sigma, drift) if self.initialised else math.inf

    def use_fractional_milliseconds(self) -> None:
        """Take times as finer than whole ms; the caller subtracts the fraction from each arrival and adds it to each result."""
        if self._whole_ms:
            self._whole_ms = False
            if self.initialised:
                self._fit()

    def add(self, instrument_ms: int, arrived_ns: int, took_ns: int | None = None) -> bool:
        """Take an instrument time and its first byte's arrival. Returns False if the count jumped; that resets the fit.

        ``took_ns``: from the request to the arrival; None: unknown.
        """
        self._seen += 1
        self.inconsistent = False
        if not self.initialised:
            self._initial.append(_Sample(instrument_ms, arrived_ns, took_ns))
            if len(self._initial) >= MIN_SAMPLES:
                self._initialise()
            return True
        x, y = self._coordinates(instrument_ms, arrived_ns)
        delay = y - self._height - self._skew * x
        if not -self._gate(x) - self._faster_by(took_ns) <= delay <= MAX_DELAY_NS:
            return self._add_inconsistent(instrument_ms, arrived_ns)
        new_bin = self._put(x, y, took_ns)
        below = y < self._height + self._skew * x
        if new_bin or below or self._samples > _REFIT_GROWTH * self._fitted:
            self._fit()
        return True

    def at(self, instrument_ms: int) -> HostTime | None:
        """Return an instrument time on the host's clock; None before initialisation."""
        if not self.initialised:
            return None
        x = float(instrument_ms * 1_000_000 - self._x0)
        drift = self._skew_sigma * abs(x - self._pivot)
        host_ns = self._x0 + self._y0 + round(x + self._height + self._lift + self._skew * x)
        sigma_ns = math.hypot(self._sigma, drift)
        return HostTime(host_ns, round(sigma_ns), round(_RESOLUTION_NS + 8 * self._excess + 3 * drift))

    def timestamp(self, instrument_ms: int, arrived_ns: int) -> HostTime | None:
        """Return the time of a distance, from its instrument time and the arrival of the first byte of its response.

        A distance is no sample unless it is inconsistent with the envelope: its delay depends on when it was requested.
        Returns None before initialisation, or for an inconsistent distance.
        """
        if self.initialised:
            x, y = self._coordinates(instrument_ms, arrived_ns)
            self.inconsistent = False
            if not 0 <= y - self._height - self._skew * x <= MAX_DELAY_NS:
                self.add(instrument_ms, arrived_ns)
        else:
            self.add(instrument_ms, arrived_ns)
        time = self.at(instrument_ms)
        if self.inconsistent or time is None or not arrived_ns <= time.host_ns + MAX_DELAY_NS:
            return None
        return time._replace(host_ns=min(time.host_ns, arrived_ns))

    # --- Samples ----------------------------------------------------------------------------------------------

    def _coordinates(self, instrument_ms: int, arrived_ns: int) -> tuple[float, float]:
        """Return instrument time, and arrival less instrument time, from the origin of this fit."""
        x = instrument_ms * 1_000_000 - self._x0
        return float(x), float(arrived_ns - self._y0 - self._x0 - x)

    def _initialise(self) -> None:
        """Fit the first samples, without outliers among them: a corrupted one, or a jump in between."""
        middle = median([each.offset_ns for each in self._initial])
        kept = [each for each in self._initial if abs(each.offset_ns - middle) <= MAX_DELAY_NS]
        kept.sort(key=lambda each: each.offset_ns)
        if len(kept) > 2 and _is_corrupted(kept[0], kept[1], middle):
            del kept[0]
        if len(kept) < MIN_SAMPLES - 1:
            # Drop the oldest, whichever it is: most samples may be from before a power cycle.
            del self._initial[0]
            return
        kept.sort(key=lambda each: each.instrument_ms)
        self._x0 = kept[0].instrument_ms * 1_000_000
        self._y0 = kept[0].arrived_ns - self._x0
        self._skew = self._known_skew
        points = [self._coordinates(each.instrument_ms, each.arrived_ns) for each in kept]
        heights = [y for _, y in points]
        self._height = min(heights)
        self._mean_delay = median(heights) - self._height
        for (x, y), each in zip(points, kept, strict=True):
            self._put(x, y, each.took_ns)
        self._initial = []
        self._fit()

    def _gate(self, x: float) -> float:
        """Return how far below the envelope a sample may lie and still be a faster response, in ns."""
        return _RESOLUTION_NS + 10 * self._excess + 3 * self._skew_sigma * abs(x - self._pivot)

    def _faster_by(self, took_ns: int | None) -> float:
        """Return by how much an exchange was faster than all before, in ns; 0 where unknown."""
        fastest = self._fastest_exchange()
        return 0.0 if took_ns is None or math.isinf(fastest) else max(fastest - took_ns, 0.0)

    def _fastest_exchange(self) -> float:
        """Return how long the fastest exchange of the window took, in ns; infinite if none is known."""
        return min([bin_.min_took for bin_ in self._bins], default=math.inf)

    def _put(self, x: float, y: float, took_ns: int | None = None) -> bool:
        """Put a sample into its bin; return whether it starts a new one."""
        bins = self._bins
        number = math.floor(x / _BIN_NS)
        new = not bins or number > bins[-1].number
        if new:
            bins.append(_Bin(number, x, y))
            oldest = number - _WINDOW_NS / _BIN_NS
            while bins[0].number < oldest and self._samples - bins[0].count >= _MIN_KEPT_SAMPLES:
                self._samples -= bins[0].count
                self._counted -= bins.popleft().counted
        bin_ = next((bin_ for bin_ in reversed(bins) if bin_.number <= number), bins[0])
        if y - self._skew * x < bin_.y - self._skew * bin_.x:
            bin_.x, bin_.y = x, y
        bin_.count += 1
        self._samples += 1
        self._newest = max(self._newest, x)
        self._slow = self._slow + 1 if took_ns is not None and self._is_slow(took_ns) else 0
        if self._slow >= _SLOW_EXCHANGES:
            return new
        self._counted += 1
        bin_.counted += 1
        bin_.sum_x += x
        bin_.sum_y += min(
            y, self._height + self._skew * x + _DELAY_CAP * max(self._mean_delay, _RESOLUTION_NS)
        )
        if took_ns is not None:
            bin_.timed += 1
            bin_.sum_took += took_ns
            bin_.min_took = min(bin_.min_took, took_ns)
        return new

    def _is_slow(self, took_ns: int) -> bool:
        """Whether an exchange took longer than usual."""
        timed = sum([bin_.timed for bin_ in self._bins])
        if timed < _MIN_TIMED:
            return False
        mean = sum([bin_.sum_took for bin_ in self._bins]) / timed
        fastest = self._fastest_exchange()
        return took_ns > fastest + _SLOW_SHARE * (mean - fastest)

    def _add_inconsistent(self, instrument_ms: int, arrived_ns: int) -> bool:
        """Hold a sample until enough others agree with it; return False if they reset the fit."""
        self.inconsistent = True
        self._candidates.append((self._seen, instrument_ms, arrived_ns))
        offsets = [arrived - ms * 1_000_000 for _, ms, arrived in self._candidates]
        recent = self._candidates[-1][0] - self._candidates[0][0] <= _CANDIDATE_WINDOW
        if len(offsets) < _CANDIDATES or not recent or max(offsets) - min(offsets) > _CANDIDATE_SPREAD_NS:
            return True
        agreeing = [_Sample(ms, arrived, None) for _, ms, arrived in self._candidates]
        points = [self._coordinates(each.instrument_ms, each.arrived_ns) for each in agreeing]
        self.inconsistent = False
        if all(abs(y - self._height - self._skew * x) <= MAX_DELAY_NS / 2 for x, y in points):
            # The minimum delay or the skew has changed: the old envelope is void, the origin stays.
            self._candidates.clear()
            self._bins.clear()
            self._samples = self._counted = 0
            for x, y in points:
                self._put(x, y)
            self._fit()
            return True
        self._reset(agreeing)
        self.resets += 1
        return False

    # --- The fit ----------------------------------------------------------------------------------------------

    def _fit(self) -> None:
        """Fit the envelope to all samples."""
        bins = self._bins
        mean_x = sum(bin_.sum_x for bin_ in bins) / self._counted
        mean_y = sum(bin_.sum_y for bin_ in bins) / self._counted
        envelope = min(bin_.y - self._skew * (bin_.x - mean_x) for bin_ in bins)
        mean_delay = mean_y - envelope
        self._mean_delay = (
            mean_delay if self._counted >= _MIN_KEPT_SAMPLES else max(mean_delay, self._mean_delay)
        )
        share = max(2 * mean_delay / max(self._counted - 1, 1) / _RESOLUTION_NS, _MIN_DELAY_SHARE)
        # Without truncation the minimum delay is exponentially distributed: mean and sigma are the same.
        lowest = minimum_delay(share) if self._whole_ms else MinimumDelay(share, share)
        line = fit_lower_envelope(
            [(bin_.x, bin_.y) for bin_ in bins],
            centre=mean_x,
            scale=lowest.sigma * _RESOLUTION_NS,
            prior=(self._known_skew, self._known_sigma),
            max_slope=_MAX_SKEW,
        )
        self._skew = line.slope
        self._skew_sigma = line.slope_sigma + _SKEW_WANDER
        counted_x = [bin_.x for bin_ in bins if bin_.counted]
        if counted_x[-1] - counted_x[0] > _STEADY_NS:
            self._known_skew, self._known_sigma = self._skew, _KNOWN_SKEW_SIGMA
        self._height = min(bin_.y - self._skew * bin_.x for bin_ in bins)
        # A time in whole ms is truncated: the distance was taken half of one later on average.
        truncation = 0.5 if self._whole_ms else 0.0
        self._lift = line.height - self._height + (truncation - lowest.mean) * _RESOLUTION_NS
        self._excess = 2 * self._mean_delay / self._counted
        rounding_ns = _ROUNDING_NS if self._whole_ms else 0.0
        # The spread is known from as many responses only: as with Student's distribution, less one for the lowest.
        few = max(self._counted - 1, 1) / max(self._counted - 3, 1)
        self._sigma = math.hypot(rounding_ns, few * lowest.sigma * _RESOLUTION_NS, line.pivot_sigma)
        self._pivot = line.pivot
        self._fitted = self._samples


def _is_corrupted(lowest: _Sample, second: _Sample, middle_ns: float) -> bool:
    """Whether the lowest sample of the first ones is too far below the second one for a response that was only faster."""
    below_ns = second.offset_ns - lowest.offset_ns
    if below_ns <= max(_FASTER_TOLERANCE_NS, 4 * (middle_ns - second.offset_ns)):
        return False
    if lowest.took_ns is None or second.took_ns is None:
        return True
    return second.took_ns - lowest.took_ns < below_ns - _FASTER_TOLERANCE_NS
