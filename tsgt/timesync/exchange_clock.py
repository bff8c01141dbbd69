"""The instrument's own time on the host's clock, from two-way exchanges over a network.

Over a network the fastest response is late by an unknown delay, so that its arrival alone says little. An exchange bounds the
clock offset from both sides: the instrument's time cannot be earlier than the request, nor later than the response. All
offsets and skews within the bounds of all exchanges are possible; how the minimum delay divides into request and response is
unknown, and stays part of the stated uncertainty (Marzullo, Owicki: Maintaining the time in a distributed system, 1983).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

from tsgt.timesync.envelope import lower_hull
from tsgt.timesync.instrument_clock import MAX_DELAY_NS, HostTime

MIN_EXCHANGES: Final = 4

_WINDOW_NS: Final = 300e9
_BIN_NS: Final = 2e9
_MIN_KEPT: Final = 30  # number of exchanges that are kept regardless of their age

_MAX_SKEW: Final = 300e-6
_SKEW_SIGMA: Final = 100e-6
_SKEW_WANDER: Final = 1e-6
_HALF_MS_NS: Final = 0.5e6
_ROUNDING_NS: Final = 0.3e6
"""Instruments state whole ms, truncated or rounded. Half of one on either side of an exchange covers both."""

_GRID_SLOPES: Final = 24
_MAX_REFINEMENTS: Final = 4
_CANDIDATES: Final = 3
_CANDIDATE_WINDOW: Final = 32
"""This many exchanges that contradict the bounds and agree with each other, in a window of this many, replace them."""


@dataclass(slots=True)
class _Bin:
    """Two seconds of exchanges: the tightest bound on either side, each with its instrument time."""

    number: int
    low_x: float
    low: float
    high_x: float
    high: float
    count: int = 0


@dataclass(frozen=True, slots=True)
class _Slope:
    """The lowest and highest offset that are possible with one skew, and the weight of that skew."""

    skew: float
    low: float
    high: float
    weight: float


class ExchangeClock:
    """Bounds the clock offset of one instrument by its exchanges.

    ``resets``: how often the instrument's count has restarted. ``inconsistent``: whether the last exchange, or distance,
    contradicts the bounds.
    """

    def __init__(self) -> None:
        self._seen = 0
        self.resets = 0
        self.inconsistent = False
        self._reset()

    def _reset(self) -> None:
        self._bins: deque[_Bin] = deque()
        self._x0 = self._y0 = 0
        self._slopes: list[_Slope] = []
        self._newest = 0.0
        self._samples = 0
        self._candidates: deque[tuple[int, int, int, int]] = deque(maxlen=_CANDIDATES)

    @property
    def initialised(self) -> bool:
        """Whether there were enough exchanges for times."""
        return self._samples >= MIN_EXCHANGES

    @property
    def samples(self) -> int:
        """How many exchanges the bounds rest on."""
        return self._samples

    @property
    def sigma_ns(self) -> float:
        """One sigma of the newest times; infinite before initialisation."""
        return self._moments(self._newest)[1] if self.initialised else math.inf

    def add(self, instrument_ms: int, sent_ns: int, arrived_ns: int) -> bool:
        """Take an exchange: the instrument's time, and when its request was sent and its response arrived.

        Returns False if the instrument's count has restarted; that resets the bounds.
        """
        self._seen += 1
        self.inconsistent = False
        if not self._samples:
            self._x0 = instrument_ms * 1_000_000
            self._y0 = arrived_ns - self._x0
        x, low, high = self._bounds(instrument_ms, sent_ns, arrived_ns)
        if self._slopes:
            possible_low, possible_high = self._range(x)
            if high < possible_low or low > possible_high:
                return self._add_inconsistent(instrument_ms, sent_ns, arrived_ns)
        if self._put(x, low, high):
            self._fit()
        return True

    def at(self, instrument_ms: int) -> HostTime | None:
        """Return an instrument time on the host's clock; None before initialisation.

        Its sigma is that of an unknown division of the minimum delay, uniformly distributed; its bound holds for any
        division.
        """
        if not self.initialised:
            return None
        x = float(instrument_ms * 1_000_000 - self._x0)
        offset, sigma = self._moments(x)
        low, high = self._range(x)
        bound = max(high - offset, offset - low) + _HALF_MS_NS
        host_ns = self._x0 + self._y0 + round(x + offset)
        return HostTime(host_ns, round(sigma), round(bound))

    def timestamp(self, instrument_ms: int, arrived_ns: int) -> HostTime | None:
        """Return the time of a distance whose response arrived at a time; None before initialisation, or if they contradict."""
        time = self.at(instrument_ms)
        if time is None:
            return None
        self.inconsistent = not time.host_ns - time.bound_ns <= arrived_ns <= time.host_ns + MAX_DELAY_NS
        return None if self.inconsistent else time._replace(host_ns=min(time.host_ns, arrived_ns))

    # --- Exchanges --------------------------------------------------------------------------------------------

    def _bounds(self, instrument_ms: int, sent_ns: int, arrived_ns: int) -> tuple[float, float, float]:
        """Return instrument time, and lowest and highest possible offset, from the origin of these bounds."""
        x = instrument_ms * 1_000_000 - self._x0
        return (
            float(x),
            sent_ns - self._y0 - self._x0 - x - _HALF_MS_NS,
            arrived_ns - self._y0 - self._x0 - x + _HALF_MS_NS,
        )

    def _put(self, x: float, low: float, high: float) -> bool:
        """Put an exchange into its bin; return whether it narrows the bounds or starts a bin."""
        bins, skew = self._bins, self._skew()
        number = math.floor(x / _BIN_NS)
        narrower = not self._slopes
        if self._slopes:
            possible_low, possible_high = self._range(x)
            narrower = low > possible_low or high < possible_high
        new = not bins or number > bins[-1].number
        if new:
            bins.append(_Bin(number, x, low, x, high))
            oldest = number - _WINDOW_NS / _BIN_NS
            while bins[0].number < oldest and self._samples - bins[0].count >= _MIN_KEPT:
                self._samples -= bins.popleft().count
        bin_ = next((bin_ for bin_ in reversed(bins) if bin_.number <= number), bins[0])
        if high - skew * x < bin_.high - skew * bin_.high_x:
            bin_.high_x, bin_.high = x, high
        if low - skew * x > bin_.low - skew * bin_.low_x:
            bin_.low_x, bin_.low = x, low
        bin_.count += 1
        self._samples += 1
        self._newest = max(self._newest, x)
        return new or narrower

    def _add_inconsistent(self, instrument_ms: int, sent_ns: int, arrived_ns: int) -> bool:
        """Hold an exchange until enough others agree with it; return False if they reset the bounds."""
        self.inconsistent = True
        self._candidates.append((self._seen, instrument_ms, sent_ns, arrived_ns))
        if len(self._candidates) < _CANDIDATES:
            return True
        recent = self._candidates[-1][0] - self._candidates[0][0] <= _CANDIDATE_WINDOW
        low = max(sent_ns - ms * 1_000_000 for _, ms, sent_ns, _ in self._candidates)
        high = min(arrived_ns - ms * 1_000_000 for _, ms, _, arrived_ns in self._candidates)
        if not recent or low - high > 2 * _HALF_MS_NS:
            return True
        agreeing = list(self._candidates)
        self._reset()
        self.resets += 1
        for _, ms, sent, arrived in agreeing:
            self.add(ms, sent, arrived)
        return False

    # --- The possible offsets ---------------------------------------------------------------------------------

    def _skew(self) -> float:
        return sum(slope.weight * slope.skew for slope in self._slopes)

    def _range(self, x: float) -> tuple[float, float]:
        """Return the lowest and the highest possible offset at an instrument time."""
        wander = _SKEW_WANDER * max(x - self._newest, 0.0)
        low = min(slope.low + slope.skew * x for slope in self._slopes)
        high = max(slope.high + slope.skew * x for slope in self._slopes)
        return low - wander, high + wander

    def _moments(self, x: float) -> tuple[float, float]:
        """Return mean and standard deviation of the offset at an instrument time, over all that are possible."""
        mean = variance = 0.0
        for slope in self._slopes:
            mean += slope.weight * ((slope.low + slope.high) / 2 + slope.skew * x)
        for slope in self._slopes:
            middle = (slope.low + slope.high) / 2 + slope.skew * x
            variance += slope.weight * ((middle - mean) ** 2 + (slope.high - slope.low) ** 2 / 12)
        return mean, math.sqrt(variance + _ROUNDING_NS**2)

    def _fit(self) -> None:
        """Find the possible offsets and skews; drop the oldest exchanges while there are none."""
        while not (slopes := self._possible()) and len(self._bins) > 1:
            self._samples -= self._bins.popleft().count
        # A single bin may contradict itself only by the wander of its clock within two seconds.
        self._slopes = slopes or self._slopes

    def _possible(self) -> list[_Slope]:
        newest = self._newest
        highs = [(b.high_x, b.high + _SKEW_WANDER * (newest - b.high_x)) for b in self._bins]
        lows = [(b.low_x, _SKEW_WANDER * (newest - b.low_x) - b.low) for b in self._bins]
        above, below = lower_hull(highs), lower_hull(lows)
        least, most = -_MAX_SKEW, _MAX_SKEW
        possible: list[tuple[float, float, float]] = []
        for _ in range(_MAX_REFINEMENTS):
            step = (most - least) / (_GRID_SLOPES - 1)
            skews = [least + i * step for i in range(_GRID_SLOPES)]
            offsets = [
                (
                    skew,
                    -min(y + skew * x for x, y in below),
                    min(y - skew * x for x, y in above),
                )
                for skew in skews
            ]
            possible = [each for each in offsets if each[1] <= each[2]]
            if len(possible) > _GRID_SLOPES // 3:
                break
            # Towards the slopes with the least contradiction.
            best = max(offsets, key=lambda each: each[2] - each[1])[0]
            first, last = (possible[0][0], possible[-1][0]) if possible else (best, best)
            least, most = max(first - step, least), min(last + step, most)
        # An earlier fit says nothing of the skew: it may be of a time when NTP slewed the host's clock.
        weights = [
            (high - low + 1.0) * math.exp(-0.5 * (skew / _SKEW_SIGMA) ** 2) for skew, low, high in possible
        ]
        total = sum(weights)
        return [_Slope(*each, weight / total) for each, weight in zip(possible, weights, strict=True)]
