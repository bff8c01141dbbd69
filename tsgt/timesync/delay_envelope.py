"""Lower envelope of offsets that are raised by delays, over a sliding window: a line that follows a clock.

Time is the x-axis, an offset between two clocks the y-axis, both in ns. A delay raises an offset by any amount, and never lowers it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, Final

from tsgt.timesync.envelope import MinimumDelay, fit_lower_envelope, minimum_delay

if TYPE_CHECKING:
    from collections.abc import Sequence

_WINDOW_NS: Final = 300e9
_BIN_NS: Final = 2e9
"""Of each bin the lowest sample is kept. A crystal in the sun changes its rate by 1e-6 in some minutes: over a longer
window the envelope is no line."""

_MIN_KEPT_SAMPLES: Final = 30  # number of samples that are kept regardless of their age

_MAX_SKEW: Final = 300e-6
_SKEW_WANDER: Final = 1e-6
"""Bound of the skew, and its wander within the window."""

RESOLUTION_NS: Final = 1e6
_ROUNDING_NS: Final = 0.3e6
"""Instruments state their time in whole ms."""

_MIN_DELAY_SHARE: Final = 0.01
_DELAY_CAP: Final = 4.0
"""A delay counts as at most this many mean delays: a stall says nothing about the others."""


def lowest_delay(mean_delay_ns: float, samples: int, *, whole_ms: bool) -> MinimumDelay:
    """Return mean and standard deviation in ns of the lowest of some samples, above the line without delays.

    ``mean_delay_ns``: their mean above the lowest one. ``whole_ms``: whether they are truncated to ms too.
    """
    share = max(2 * mean_delay_ns / max(samples - 1, 1) / RESOLUTION_NS, _MIN_DELAY_SHARE)
    # Without truncation the minimum delay is exponentially distributed: mean and sigma are the same.
    lowest = minimum_delay(share) if whole_ms else MinimumDelay(share, share)
    return MinimumDelay(RESOLUTION_NS * lowest.mean, RESOLUTION_NS * lowest.sigma)


def few_samples(samples: int) -> float:
    """Return the factor on sigma where the spread of delays is known from so many samples: as with Student's distribution."""
    return max(samples - 1, 1) / max(samples - 3, 1)  # less one for the lowest


def capped(delay_ns: float, mean_delay_ns: float) -> float:
    """Return a delay as it counts in the mean."""
    return min(delay_ns, _DELAY_CAP * max(mean_delay_ns, RESOLUTION_NS))


@dataclass(slots=True)
class _Bin:
    """Two seconds of samples: the lowest one, and sums over all."""

    number: int
    x: float
    y: float
    count: int = 0
    sum_x: float = 0.0
    sum_y: float = 0.0


class DelayEnvelope:
    """Fits the line below the samples of the last five minutes.

    ``skew``: its slope. ``mean_delay``: mean height of the samples above it, in ns. ``excess``: how far the lowest one lies
    above it, as a multiple of which the bound is stated, in ns.
    """

    def __init__(self, skew: float, heights: Sequence[float]) -> None:
        """Expect samples about these heights above the origin, the first ones, at this skew."""
        self.samples = 0
        self.skew = skew
        self.mean_delay = median(heights) - min(heights)
        self.excess = 0.0
        self._bins: deque[_Bin] = deque()
        self._lowest = min(heights)
        self._height = self._sigma = self._pivot = self._skew_sigma = 0.0

    @property
    def span_ns(self) -> float:
        """Duration of the samples."""
        return self._bins[-1].x - self._bins[0].x if self._bins else 0.0

    def lowest_at(self, x: float) -> float:
        """Return the line through the lowest sample."""
        return self._lowest + self.skew * x

    def at(self, x: float) -> float:
        """Return the line without delay and truncation."""
        return self._height + self.skew * x

    def sigma_at(self, x: float) -> float:
        """Return one sigma of that line."""
        return math.hypot(self._sigma, self.drift(x))

    def drift(self, x: float) -> float:
        """Return one sigma of that line by the skew alone."""
        return self._skew_sigma * abs(x - self._pivot)

    def clear(self) -> None:
        """Forget all samples; skew and mean delay stay."""
        self._bins.clear()
        self.samples = 0

    def put(self, x: float, y: float) -> bool:
        """Take a sample; return whether it asks for a new fit."""
        bins = self._bins
        number = math.floor(x / _BIN_NS)
        new = not bins or number > bins[-1].number
        if new:
            bins.append(_Bin(number, x, y))
            oldest = number - _WINDOW_NS / _BIN_NS
            while bins[0].number < oldest and self.samples - bins[0].count >= _MIN_KEPT_SAMPLES:
                self.samples -= bins.popleft().count
        bin_ = next((bin_ for bin_ in reversed(bins) if bin_.number <= number), bins[0])
        if y - self.skew * x < bin_.y - self.skew * bin_.x:
            bin_.x, bin_.y = x, y
        lowest = self.lowest_at(x)
        bin_.count += 1
        bin_.sum_x += x
        bin_.sum_y += lowest + capped(y - lowest, self.mean_delay)
        self.samples += 1
        return new or y < lowest

    def fit(self, known_skew: tuple[float, float], *, whole_ms: bool) -> None:
        """Fit the line to all samples.

        ``known_skew``: what is known of the skew otherwise, and its standard deviation.
        """
        bins = self._bins
        mean_x = sum([bin_.sum_x for bin_ in bins]) / self.samples
        mean_y = sum([bin_.sum_y for bin_ in bins]) / self.samples
        mean_delay = mean_y - min([bin_.y - self.skew * (bin_.x - mean_x) for bin_ in bins])
        enough = self.samples >= _MIN_KEPT_SAMPLES
        self.mean_delay = mean_delay if enough else max(mean_delay, self.mean_delay)
        self.excess = 2 * self.mean_delay / self.samples
        lowest = lowest_delay(mean_delay, self.samples, whole_ms=whole_ms)
        line = fit_lower_envelope(
            [(bin_.x, bin_.y) for bin_ in bins],
            centre=mean_x,
            scale=lowest.sigma,
            prior=known_skew,
            max_slope=_MAX_SKEW,
        )
        self.skew, self._skew_sigma = line.slope, line.slope_sigma + _SKEW_WANDER
        self._lowest = min([bin_.y - self.skew * bin_.x for bin_ in bins])
        self._height, self._pivot = line.height - lowest.mean, line.pivot
        rounding_ns = _ROUNDING_NS if whole_ms else 0.0
        self._sigma = math.hypot(rounding_ns, few_samples(self.samples) * lowest.sigma, line.pivot_sigma)
