"""A stretch of time over which a clock's rate wanders, but does not break: two fits through all its comparisons.

The *slow* fit takes the rate to be as steady as that of crystals in the field, and gives the value. The *quick* one
trusts it for seconds only. It is noisier, but what a clock can do without being noticed at once stays within five of
its standard errors: the truth is near the quick fit, and the bound of the slow fit is its distance from there. Where
both part company the rate has changed, and the slow fit goes on from the quick one.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from typing import TYPE_CHECKING, NamedTuple

from tsgt.timesync.kalman import Estimate, carried, corrected, merged

if TYPE_CHECKING:
    from collections.abc import Callable

_SLOW_WALK_PPM2_PER_S = 0.006
"""The rate of the slow fit walks 0.6 ppm in a minute: with a pair every 0.4 s it averages over 20 to 30 s."""

_QUICK_WALK_PPM2_PER_S = 6.0
"""That of the quick fit walks 2.5 ppm in a second: it averages over 3 s or so."""
_QUICK_WALKS_S = 10.0
"""In a longer outage it does not walk further: crystals do not."""

SIGMAS = 5.0
"""The truth is within so many standard errors of the quick fit."""

_SUDDEN_PPM = 25.0
_SUDDEN_S = 2.0
"""The rate may have changed by this since the last comparison, unseen so far; if it was longer ago, the quick fit
allows for it."""

_PARTED = 3.0
"""If the fits are further apart than so many standard errors of the quick one, the rate has changed."""

_STRAIN_WEIGHT = 0.4
_USUAL_STRAIN = 2.0
_LARGEST_STRAIN = 25.0
"""Strain is how much worse than expected the last few pairs fit. Up to twice is usual; beyond that the quick fit states
a larger error and takes the rate to walk faster."""

_HORIZON_NS = 30_000_000_000
_ENOUGH_NS = 20_000_000_000
"""What came after an instant is told by so much of it: the rest hardly counts, and takes long."""


class Pair(NamedTuple):
    """A comparison: when this computer received a beacon, and when the other had sent it.

    Attributes
    ----------
    received_ns
        On this computer's clock.
    sent_ns
        On the other's.
    sigma_ns
        One sigma of ``received_ns``, as stated.
    variance_us2
        Of their difference, in us^2.
    """

    received_ns: int
    sent_ns: int
    sigma_ns: int
    variance_us2: float


class Fits(NamedTuple):
    """Both fits at one instant.

    Attributes
    ----------
    slow, quick
        See the module.
    strain
        Square of what the last pairs missed the quick fit by, over what was expected of them; 1 or more.
    """

    slow: Estimate
    quick: Estimate
    strain: float = 1.0


class Stretch:
    """Follows the offset of the other clock, ``sent_ns - received_ns``, from pair to pair.

    Parameters
    ----------
    pair
        The first one.
    rate_ppm, rate_sigma_ppm
        What is known of the rate beforehand; positive: the other clock gains on this one.
    """

    def __init__(self, pair: Pair, rate_ppm: float, rate_sigma_ppm: float) -> None:
        self.base_ns = pair.sent_ns - pair.received_ns
        self._rate_ppm, self._rate_variance = rate_ppm, rate_sigma_ppm**2
        start = Estimate(0.0, rate_ppm, pair.variance_us2, 0.0, self._rate_variance)
        self._pairs = [pair]
        self._received_ns = [pair.received_ns]
        self._before = [Fits(start, start)]
        self._after: dict[int, Fits] = {}
        self._after_from = self._after_to = -1

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def first_ns(self) -> int:
        """When its first pair was received."""
        return self._received_ns[0]

    @property
    def last_ns(self) -> int:
        """When its newest pair was received."""
        return self._received_ns[-1]

    @property
    def rate_ppm(self) -> float:
        """Rate at the newest pair, by the quick fit."""
        return self._before[-1].quick.rate_ppm

    def missed_us(self, pair: Pair) -> float:
        """Return by how much the quick fit misses a new pair, in us."""
        return self._offset_us(pair) - self._expected(pair).offset_us

    def agrees(self, pair: Pair) -> bool:
        """Tell whether jitter and what clocks do can explain a new pair."""
        return abs(self.missed_us(pair)) <= self._allowed_us(pair, self._expected(pair))

    def agrees_closely(self, pair: Pair) -> bool:
        """Tell whether jitter can explain a new pair, however long ago the one before it was."""
        return abs(self.missed_us(pair)) <= self._allowed_us(pair, self._before[-1].quick)

    def _allowed_us(self, pair: Pair, expected: Estimate) -> float:
        sudden_us = _SUDDEN_PPM * min(_seconds(pair.received_ns - self.last_ns), _SUDDEN_S)
        return SIGMAS * math.sqrt(expected.offset_variance + pair.variance_us2) + sudden_us

    def add(self, pair: Pair) -> None:
        """Take a pair that is newer than all before."""
        self._before.append(self._step(self._before[-1], self._pairs[-1], pair))
        self._pairs.append(pair)
        self._received_ns.append(pair.received_ns)

    def add_all(self, other: Stretch) -> None:
        """Take the pairs of another stretch, all newer than all before."""
        for pair in other._pairs:
            self.add(pair)

    def weighed_anew(self, variance_us2: Callable[[int], float]) -> Stretch:
        """Return the fit through the same pairs with other variances, given for each ``sigma_ns``."""
        first, *others = (pair._replace(variance_us2=variance_us2(pair.sigma_ns)) for pair in self._pairs)
        stretch = Stretch(first, self._rate_ppm, math.sqrt(self._rate_variance))
        for pair in others:
            stretch.add(pair)
        return stretch

    def forget(self, pairs: int) -> None:
        """Let go of the oldest pairs; what they told of later times stays."""
        del self._pairs[:pairs], self._received_ns[:pairs], self._before[:pairs]
        self._after.clear()
        self._after_from = self._after_to = -1

    def at(self, local_ns: int) -> tuple[Fits, float]:
        """Return both fits at an instant of this computer's clock, and the distance of the nearest pair in s."""
        following = bisect_right(self._received_ns, local_ns)
        if following == len(self._pairs):
            near_s = _seconds(local_ns - self.last_ns)
            return _carried(self._before[-1], near_s), near_s
        until_s = _seconds(local_ns - self._received_ns[following])
        later = _carried(self._fits_after(following), until_s)
        if following == 0:
            return later, -until_s
        since_s = _seconds(local_ns - self._received_ns[following - 1])
        earlier = _carried(self._before[following - 1], since_s)
        fits = Fits(
            merged(earlier.slow, later.slow),
            merged(earlier.quick, later.quick),
            max(earlier.strain, later.strain),
        )
        return fits, min(since_s, -until_s)

    def _fits_after(self, index: int) -> Fits:
        """Return the fits at a pair by that pair and those after it, as far as they count."""
        pairs, times, newest = self._pairs, self._received_ns, len(self._pairs) - 1
        begun, reached = self._after_from, self._after_to
        enough = begun == newest or times[begun] - times[index] >= _ENOUGH_NS
        if index > begun or not enough or times[reached] - times[index] > _HORIZON_NS:
            start = min(bisect_left(times, times[index] + _HORIZON_NS), newest)
            rate_ppm = self._before[start].slow.rate_ppm
            first = Estimate(
                self._offset_us(pairs[start]), rate_ppm, pairs[start].variance_us2, 0.0, self._rate_variance
            )
            self._after = {start: Fits(first, first)}
            self._after_from = self._after_to = start
        fits = self._after[self._after_to]
        while self._after_to > index:
            fits = self._step(fits, pairs[self._after_to], pairs[self._after_to - 1])
            self._after_to -= 1
            self._after[self._after_to] = fits
        return self._after[index]

    def _step(self, fits: Fits, pair: Pair, following: Pair) -> Fits:
        """Go on from a pair to the following one, forwards or backwards in time."""
        slow, quick, strain = _carried(fits, _seconds(following.received_ns - pair.received_ns))
        offset_us, variance = self._offset_us(following), following.variance_us2
        missed = (offset_us - quick.offset_us) ** 2 / (quick.offset_variance + variance)
        strain += _STRAIN_WEIGHT * (min(missed, _LARGEST_STRAIN) - strain)
        slow, quick = corrected(slow, offset_us, variance), corrected(quick, offset_us, variance)
        parted = (slow.offset_us - quick.offset_us) ** 2 > _PARTED**2 * quick.offset_variance
        return Fits(quick if parted else slow, quick, strain)

    def _expected(self, pair: Pair) -> Estimate:
        return _carried(self._before[-1], _seconds(pair.received_ns - self.last_ns)).quick

    def _offset_us(self, pair: Pair) -> float:
        return (pair.sent_ns - pair.received_ns - self.base_ns) / 1000


def bound_us(fits: Fits, near_s: float) -> float:
    """Return what the slow fit is within of the truth, in us; ``near_s`` is how far the nearest pair is."""
    quick_us = SIGMAS * math.sqrt(_excess(fits) * fits.quick.offset_variance) + _SUDDEN_PPM * min(
        near_s, _SUDDEN_S
    )
    return quick_us + abs(fits.slow.offset_us - fits.quick.offset_us)


def rate_bound_ppm(fits: Fits) -> float:
    """Return what the rate of the slow fit is within of the truth, in ppm."""
    quick_ppm = SIGMAS * math.sqrt(_excess(fits) * fits.quick.rate_variance) + _SUDDEN_PPM
    return quick_ppm + abs(fits.slow.rate_ppm - fits.quick.rate_ppm)


def _excess(fits: Fits) -> float:
    return max(fits.strain - _USUAL_STRAIN + 1, 1.0)


def _carried(fits: Fits, by_s: float) -> Fits:
    gone_s = abs(by_s)
    walk_ppm2 = _QUICK_WALK_PPM2_PER_S * _excess(fits) ** 2 * min(gone_s, _QUICK_WALKS_S)
    return Fits(
        carried(fits.slow, by_s, _SLOW_WALK_PPM2_PER_S * gone_s),
        carried(fits.quick, by_s, walk_ppm2),
        fits.strain,
    )


def _seconds(duration_ns: int) -> float:
    return duration_ns / 1e9
