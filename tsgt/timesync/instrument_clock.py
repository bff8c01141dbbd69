"""The instrument's own time on the host's clock, from when its answers arrived.

An answer carries the instrument's time of a measurement, in ms since it was switched on. It arrives later by what the
instrument and the line need: sometimes more, never less than the fastest way. So, over instrument time, "arrival less
instrument time" lies above a line, the lower envelope, whose height is the offset of the clocks plus that fastest way
and whose slope is how much slower the instrument's clock runs. docs/explanation/instrument-time.md says how well the
fit does, and what it cannot see.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from tsgt.timesync.envelope import Lowest, line_below, lowest

ENOUGH = 8
"""So many samples make an envelope."""

LATEST_NS = 2_000_000_000
"""An answer that is further behind the fastest way than this is not taken for a late one: something has jumped."""

_WINDOW_NS = 300e9
_BIN_NS = 2e9
"""Of each bin the lowest sample is kept. A crystal in the sun changes its rate by 1e-6 in some minutes: in a longer
window the line would no longer be one."""

_KEPT = 30
"""So many samples are kept however old they are."""

_STEADY_NS = 120e9
"""A rate that was found over a longer span than this is kept over a power cycle."""

_MOST_RATE = 300e-6
_UNKNOWN_RATE = 60e-6
_KNOWN_RATE = 5e-6
"""Two clocks run apart by no more than the first, usually by less than the second, and about as they did before."""
_WANDER = 1e-6

_RESOLUTION_NS = 1e6
_ROUNDING_NS = 0.3e6
"""Instruments tell their time in whole ms; whether rounded or cut off is not known, and makes no difference here: what is
added to one of their times is missing in what the envelope's height was found from."""

_MORE = 1.05
"""By so much there are to be more samples before it is worth fitting again without other news."""

_LEAST_SHARE = 0.01
_LATE = 4.0
"""An answer that is later than so many times the mean counts for so much: it stalled, and tells nothing of the others."""

_FEW = 3
_AGREE_NS = 100e6
_MEMORY = 32
"""So many samples that contradict the envelope and agree with each other this well, among so many, outvote it."""


class HostTime(NamedTuple):
    """An instant of the instrument on the host's CLOCK_MONOTONIC, plus the time of the fastest way.

    Attributes
    ----------
    host_ns
        The instant.
    sigma_ns
        One standard error, of what samples can tell.
    bound_ns
        The truth is within this of ``host_ns``, as long as the fastest way stays what it is.
    """

    host_ns: int
    sigma_ns: int
    bound_ns: int


@dataclass(slots=True)
class _Bin:
    """What is kept of two seconds: the lowest sample, and sums over all."""

    number: int
    x: float
    y: float
    count: int = 0
    sum_x: float = 0.0
    sum_y: float = 0.0


class InstrumentClock:
    """Fits the lower envelope; one for each instrument.

    A sample far from the envelope is doubted: it enters only when others agree with it. Where these are too far off for
    any delay, the instrument has been switched off and on, or its count has jumped or begun anew: so does the fit.

    Attributes
    ----------
    began
        How often the count has begun anew.
    doubts
        Whether the last sample, or distance, is doubted.
    """

    def __init__(self) -> None:
        self._whole_ms = True
        self._known_rate = 0.0  # of the host against the instrument, less 1; outlives a power cycle
        self._known_sigma = _UNKNOWN_RATE
        self._seen = 0
        self.began = 0
        self.doubts = False
        self._begin([])

    def _begin(self, samples: list[tuple[int, int]]) -> None:
        self._first = samples
        self._bins: deque[_Bin] = deque()
        self._x0 = self._y0 = 0
        self._a = self._b = self._lift = 0.0
        self._above = self._excess = self._sigma = 0.0
        self._rate_sigma = self._known_sigma
        self._newest = self._middle = 0.0
        self._samples = self._fitted = 0
        self._doubted: deque[tuple[int, int, int]] = deque(maxlen=_FEW)

    @property
    def stands(self) -> bool:
        """Whether there were enough samples for times to be told."""
        return self._samples > 0

    @property
    def samples(self) -> int:
        """How many samples the envelope lies under."""
        return self._samples

    @property
    def rate_ppm(self) -> float:
        """By how much the host's clock gains on the instrument's, in 1e-6."""
        return self._b * 1e6

    @property
    def sigma_ns(self) -> float:
        """One standard error of the newest times; infinite while none are told."""
        drift = self._rate_sigma * abs(self._newest - self._middle)
        return math.hypot(self._sigma, drift) if self.stands else math.inf

    def expect_parts(self) -> None:
        """Take it that times are told finer than in whole ms: an arrival is less by the part, and so is what is told."""
        if self._whole_ms:
            self._whole_ms = False
            if self.stands:
                self._fit()

    def add(self, instrument_ms: int, arrived_ns: int) -> bool:
        """Take a sample: an instrument time, and when the first byte of the answer with it arrived.

        Returns
        -------
        bool
            False if the instrument's count has jumped: what was known of it is forgotten.
        """
        self._seen += 1
        self.doubts = False
        if not self.stands:
            self._first.append((instrument_ms, arrived_ns))
            if len(self._first) >= ENOUGH:
                self._start()
            return True
        x, y = self._place(instrument_ms, arrived_ns)
        late = y - self._a - self._b * x
        if not -self._allowed(x) <= late <= LATEST_NS:
            return self._doubt(instrument_ms, arrived_ns)
        self._take(x, y)
        return True

    def at(self, instrument_ms: int) -> HostTime | None:
        """Return when that was on the host's clock; None where it is not known (yet)."""
        if not self.stands:
            return None
        x = float(instrument_ms * 1_000_000 - self._x0)
        drift = self._rate_sigma * abs(x - self._middle)
        host_ns = self._x0 + self._y0 + round(x + self._a + self._lift + self._b * x)
        sigma_ns = math.hypot(self._sigma, drift)
        return HostTime(host_ns, round(sigma_ns), round(_RESOLUTION_NS + 8 * self._excess + 3 * drift))

    def stamp(self, instrument_ms: int, arrived_ns: int) -> HostTime | None:
        """Return when a distance was taken, from that and from when the first byte of the answer with it arrived.

        It is no sample, unless it contradicts those there are: how late a distance comes depends on when it is asked for,
        so that the fastest ones are no measure.

        Returns
        -------
        HostTime or None
            None where it is not known, or the distance contradicts what is known.
        """
        if self.stands:
            x, y = self._place(instrument_ms, arrived_ns)
            self.doubts = False
            if not 0 <= y - self._a - self._b * x <= LATEST_NS:
                self.add(instrument_ms, arrived_ns)
        else:
            self.add(instrument_ms, arrived_ns)
        time = self.at(instrument_ms)
        if self.doubts or time is None or not arrived_ns <= time.host_ns + LATEST_NS:
            return None
        return time._replace(host_ns=min(time.host_ns, arrived_ns))

    # --- Samples ----------------------------------------------------------------------------------------------

    def _place(self, instrument_ms: int, arrived_ns: int) -> tuple[float, float]:
        """Return instrument time, and arrival less that, from the origin of this fit."""
        x = instrument_ms * 1_000_000 - self._x0
        return float(x), float(arrived_ns - self._y0 - self._x0 - x)

    def _start(self) -> None:
        """Begin with the first samples, without what does not belong to the others: a damaged one, a jump between."""
        offsets = [arrived_ns - ms * 1_000_000 for ms, arrived_ns in self._first]
        middle = median(offsets)
        kept = [
            sample
            for sample, y in sorted(zip(self._first, offsets, strict=True), key=lambda pair: pair[1])
            if abs(y - middle) <= LATEST_NS
        ]
        if len(kept) > 2:
            lowest, second = (arrived - ms * 1_000_000 for ms, arrived in kept[:2])
            if second - lowest > max(5e6, 4 * (middle - second)):
                del kept[0]
        if len(kept) < ENOUGH - 1:
            # The oldest goes, whatever it is: samples from before a power cycle may be the most of them.
            del self._first[0]
            return
        kept.sort()
        self._x0 = kept[0][0] * 1_000_000
        self._y0 = kept[0][1] - self._x0
        self._b = self._known_rate
        placed = [self._place(*sample)[1] for sample in kept]
        self._a = min(placed)
        self._above = median(placed) - self._a
        for ms, arrived_ns in kept:
            self._put(*self._place(ms, arrived_ns))
        self._first = []
        self._fit()

    def _allowed(self, x: float) -> float:
        """Return how far below the envelope a sample may lie and be a faster answer than any before it, in ns."""
        return _RESOLUTION_NS + 10 * self._excess + 3 * self._rate_sigma * abs(x - self._middle)

    def _take(self, x: float, y: float) -> None:
        new = self._put(x, y)
        if new or y < self._a + self._b * x or self._samples > _MORE * self._fitted:
            self._fit()

    def _put(self, x: float, y: float) -> bool:
        """Put a sample into its bin; return whether it is the first of a new one."""
        bins = self._bins
        number = math.floor(x / _BIN_NS)
        new = not bins or number > bins[-1].number
        if new:
            bins.append(_Bin(number, x, y))
            while bins[0].number < number - _WINDOW_NS / _BIN_NS and self._samples - bins[0].count >= _KEPT:
                self._samples -= bins.popleft().count
        place = next((bin_ for bin_ in reversed(bins) if bin_.number <= number), bins[0])
        if y - self._b * x < place.y - self._b * place.x:
            place.x, place.y = x, y
        place.count += 1
        place.sum_x += x
        place.sum_y += min(y, self._a + self._b * x + _LATE * max(self._above, _RESOLUTION_NS))
        self._samples += 1
        self._newest = max(self._newest, x)
        return new

    def _doubt(self, instrument_ms: int, arrived_ns: int) -> bool:
        """Keep a sample apart; believe it with the others that agree with it, when there are enough of them."""
        self.doubts = True
        self._doubted.append((self._seen, instrument_ms, arrived_ns))
        offsets = [arrived - ms * 1_000_000 for _, ms, arrived in self._doubted]
        recent = self._doubted[-1][0] - self._doubted[0][0] <= _MEMORY
        if len(offsets) < _FEW or not recent or max(offsets) - min(offsets) > _AGREE_NS:
            return True
        agreed = [(ms, arrived) for _, ms, arrived in self._doubted]
        placed = [self._place(*sample) for sample in agreed]
        if all(abs(y - self._a - self._b * x) <= LATEST_NS / 2 for x, y in placed):
            # Answers have become faster, or the rate is another: what was lowest before is not any more.
            self._doubted.clear()
            self._bins.clear()
            self._samples = 0
            for x, y in placed:
                self._put(x, y)
            self._fit()
            self.doubts = False
            return True
        self._begin(agreed)
        self.began += 1
        self.doubts = False
        return False

    # --- The fit ----------------------------------------------------------------------------------------------

    def _fit(self) -> None:
        """Lay the line below all samples, with as much of the rate from them as they tell."""
        bins = self._bins
        mean_x = sum(bin_.sum_x for bin_ in bins) / self._samples
        mean_y = sum(bin_.sum_y for bin_ in bins) / self._samples
        envelope = min(bin_.y - self._b * (bin_.x - mean_x) for bin_ in bins)
        above = mean_y - envelope
        self._above = above if self._samples >= _KEPT else max(above, self._above)
        share = max(2 * above / max(self._samples - 1, 1) / _RESOLUTION_NS, _LEAST_SHARE)
        # The lowest of answers of which nothing is cut off is above the line as a wait is long: mean and sigma are the same.
        height = lowest(share) if self._whole_ms else Lowest(share, share)
        line = line_below(
            [(bin_.x, bin_.y) for bin_ in bins],
            middle=mean_x,
            scale=height.sigma * _RESOLUTION_NS,
            known=(self._known_rate, self._known_sigma),
            most=_MOST_RATE,
        )
        self._b = line.slope
        self._rate_sigma = line.slope_sigma + _WANDER
        if bins[-1].x - bins[0].x > _STEADY_NS:
            self._known_rate, self._known_sigma = self._b, _KNOWN_RATE
        self._a = min(bin_.y - self._b * bin_.x for bin_ in bins)
        # Of a time in whole ms: a distance was taken within the one that follows, on average half of it later.
        cut_off = 0.5 if self._whole_ms else 0.0
        self._lift = line.height - self._a + (cut_off - height.mean) * _RESOLUTION_NS
        self._excess = 2 * self._above / self._samples
        rounding_ns = _ROUNDING_NS if self._whole_ms else 0.0
        self._sigma = math.hypot(rounding_ns, height.sigma * _RESOLUTION_NS, line.pivot_sigma)
        self._middle = line.pivot
        self._fitted = self._samples
