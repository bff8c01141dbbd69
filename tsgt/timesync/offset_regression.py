"""A straight line through a station's clock offsets: which exchanges count, the fit, and how far it may be off.

The arithmetic under the filter ``regression`` of :mod:`tsgt.timesync.two_way`. Offsets are in ns, times in s from
the last exchange, frequencies in ns/s (1e-9, or 0.001 ppm).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ClockSample

Int64s = NDArray[np.int64]
Floats = NDArray[np.float64]

PPM = 1000.0
"""In ns/s."""

STAMP_FLOOR_NS = 100_000
"""What a stamp may be off by at best.

Interrupt to stamp takes some microseconds; when RxDone comes after the end of a packet is known to about 0.05
symbols, 100 us at SF 9 and 250 kHz.
"""

UNKNOWN_FREQUENCY_SIGMA = 30 * PPM
"""One sigma of a frequency that was never measured: crystals of small computers agree to some tens of ppm."""

LARGEST_FREQUENCY = 100 * PPM
"""No two crystals disagree by more."""

# How fast a frequency may change, by temperature: 6 ppm in ten minutes, and never by more than 20 ppm in all.
_WANDER_NS_PER_S2 = 0.01 * PPM
_WANDER_LIMIT = 20 * PPM

# What it usually does in the weights of the past: a tenth.
_USUAL_WANDER_NS_PER_S2 = 0.001 * PPM

# An exchange slower than the fastest by this much weighs half as much.
_HALF_WEIGHT_EXCESS_NS = 2_000_000

# Stamps scatter by this much when too few of them are there to tell.
_USUAL_NOISE_NS = 10_000.0
_USUAL_NOISE_WEIGHT = 2

_SIGMAS_IN_BOUND = 4.0


def highest_offset_ns(sample: ClockSample) -> int:
    """Return the offset if the station stamped the request in time; a late stamp makes it too high."""
    return sample.station_ns - sample.sent_ns - sample.forward_ns


@dataclass(frozen=True, slots=True)
class Batch:
    """What counts of one synchronisation: an entry per exchange, at least one, in the order of time."""

    station_ns: Int64s
    offset_ns: Int64s
    """See :func:`highest_offset_ns`."""
    excess_ns: Int64s

    @property
    def doubt_ns(self) -> float:
        """How late the stamps may be, if one stands alone; those that agree confirm each other."""
        return abs(float(self.excess_ns[0])) if len(self.excess_ns) == 1 else 0.0


@dataclass(frozen=True, slots=True)
class Frequency:
    """What is known of a frequency: mean and one sigma, in ns/s."""

    mean: float
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """Offset over station time, and how well it is known."""

    origin_ns: int
    """Station time of the last exchange."""
    base_ns: int
    """Offset that ``offset_ns`` counts from; offsets of whole years do not fit into a float."""
    offset_ns: float
    frequency: float
    variances: tuple[float, float, float]
    """Of the offset in ns^2, of offset and frequency, of the frequency."""
    since_s: float
    until_s: float
    """The span that the line is sure of; not above zero."""
    least_excess_ns: float
    gap_s: float
    """So long may the frequency have been changing unseen at the end of the span."""
    noise_ns: float
    """Scatter of the stamps within a synchronisation, one sigma."""
    bend: float
    """What the last synchronisation missed the line before by, over the gap, in ns/s; not negative."""

    def at_ns(self, station_ns: int) -> int:
        """Return the offset at that station time."""
        return self.base_ns + round(self.offset_ns + self.frequency * self._seconds(station_ns))

    def sigma_ns(self, station_ns: int) -> float:
        """Return what the scatter of the stamps leaves open, one sigma."""
        t = self._seconds(station_ns)
        of_offset, of_both, of_frequency = self.variances
        return math.sqrt(max(of_offset + t * (2 * of_both + t * of_frequency), 0.0))

    def wander_ns(self, station_ns: int) -> float:
        """Return what a changing frequency adds at most outside the span.

        A frequency that changes by a each second has gone off by ``a t^2 / 2`` after t; a line through two points
        a gap apart is tangent to the middle between them, which makes it ``a t (t + gap) / 2``.
        """
        t = self._seconds(station_ns)
        outside_s = max(t - self.until_s, self.since_s - t, 0.0)
        change = min(_WANDER_NS_PER_S2 * (outside_s + self.gap_s) / 2, _WANDER_LIMIT)
        return outside_s * (change + self.bend)

    def uncertainty_ns(self, station_ns: int) -> float:
        """Return how far the line may be off, besides by lateness that all stamps share."""
        return STAMP_FLOOR_NS + _SIGMAS_IN_BOUND * self.sigma_ns(station_ns) + self.wander_ns(station_ns)

    def missed_ns(self, batch: Batch) -> float:
        """Return by how much this line foretold the offsets of a batch wrongly; not negative."""
        return abs(float(np.median(self._deviations_ns(batch))))

    def consistent_with(self, batch: Batch) -> bool:
        """Whether what a batch leaves possible overlaps with what this line does; the clock was set otherwise."""
        uncertainty_ns = self.uncertainty_ns(int(batch.station_ns[-1]))
        deviations_ns = self._deviations_ns(batch)
        lowest_ns = float((deviations_ns - batch.excess_ns).max())
        highest_ns = float(deviations_ns.min())
        return lowest_ns <= uncertainty_ns and highest_ns >= -uncertainty_ns - self.least_excess_ns

    def _deviations_ns(self, batch: Batch) -> Floats:
        foretold_ns = [self.at_ns(station_ns) for station_ns in batch.station_ns.tolist()]
        return (batch.offset_ns - np.array(foretold_ns, dtype=np.int64)).astype(np.float64)

    def _seconds(self, station_ns: int) -> float:
        return (station_ns - self.origin_ns) / 1e9


def sag_ns(since_s: float, until_s: float) -> float:
    """Return how far an offset may lie off the straight line between two that are known, in ns.

    A frequency that changes by a each second bends the line by ``a s u / 2`` at s after the one and u before the other.

    Parameters
    ----------
    since_s, until_s
        From the one before, and to the one after, in s.
    """
    return since_s * until_s * min(_WANDER_NS_PER_S2 / 2, _WANDER_LIMIT / max(since_s + until_s, 1e-9))


def sift(samples: Sequence[ClockSample], frequency: float, noise_ns: float | None = None) -> Batch:
    """Leave out the exchanges of a synchronisation that cannot be, those before a step, and those stamped late.

    Parameters
    ----------
    samples
        At least one, in the order of time.
    frequency
        Of the clock as known before, in ns/s. Long synchronisations have one of their own.
    noise_ns
        What stamps scatter by, one sigma, if that is known; a few of them do not tell.
    """
    possible = [s for s in samples if s.excess_ns >= -STAMP_FLOOR_NS] or samples
    usable = _after_the_last_step(possible)
    station_ns = np.array([s.station_ns for s in usable], dtype=np.int64)
    offset_ns = np.array([highest_offset_ns(s) for s in usable], dtype=np.int64)
    excess_ns = np.array([s.excess_ns for s in usable], dtype=np.int64)
    t = (station_ns - station_ns[-1]) / 1e9
    y = (offset_ns - offset_ns[-1]).astype(np.float64)
    if len(usable) >= 10:
        frequency = _middle_slope(t, y)
    # Lateness only ever adds, so the lowest offsets tell what a punctual stamp looks like: the lowest one together
    # with the usual scatter, or the lowest quarter with its own.
    flat = y - frequency * t
    least, quarter = np.quantile(flat, [0.0, 0.25])
    limit = quarter + 4 * (quarter - least) if noise_ns is None else least + 6 * noise_ns
    kept = flat <= max(limit, least + STAMP_FLOOR_NS / 2)
    return Batch(station_ns[kept], offset_ns[kept], excess_ns[kept])


def _middle_slope(t: Floats, y: Floats) -> float:
    """Return the median of all pairs' slopes, which bears a quarter of late stamps (Theil and Sen)."""
    first, second = np.triu_indices(len(t), 1)
    run = t[second] - t[first]
    return float(np.median((y[second] - y[first])[run > 0] / run[run > 0])) if (run > 0).any() else 0.0


def _after_the_last_step(samples: Sequence[ClockSample]) -> Sequence[ClockSample]:
    """Go back from the newest exchange for as long as one and the same clock can have made all of them."""
    newest = samples[-1]
    lowest_ns, highest_ns = -math.inf, math.inf
    for index in reversed(range(len(samples))):
        sample = samples[index]
        slack_ns = STAMP_FLOOR_NS + LARGEST_FREQUENCY * (newest.sent_ns - sample.sent_ns) / 1e9
        offset_ns = highest_offset_ns(sample) - highest_offset_ns(newest)
        lowest_ns = max(lowest_ns, offset_ns - max(sample.excess_ns, 0) - slack_ns)
        highest_ns = min(highest_ns, offset_ns + slack_ns)
        if lowest_ns > highest_ns:
            return samples[index + 1 :]
    return samples


def confirmed(batches: Sequence[Batch]) -> Sequence[Batch]:
    """Return the synchronisations whose stamps confirm each other, or all if there is none."""
    return [batch for batch in batches if batch.doubt_ns == 0] or batches


def gap_s(batches: Sequence[Batch]) -> float:
    """Return the time from the last but one synchronisation to the end of the last, or how long the only one took."""
    newest = batches[-1].station_ns
    since_ns = batches[-2].station_ns[-1] if len(batches) > 1 else newest[0]
    return max(float(newest[-1] - since_ns) / 1e9, 1.0)


def fit(batches: Sequence[Batch], prior: Frequency, bend: float) -> tuple[Line, bool]:
    """Fit the line, by weighted least squares with the prior on the frequency as one more observation.

    Three things make an offset uncertain: the noise of the stamps, taken from their scatter within synchronisations,
    less for fast round trips; the doubt about a stamp that stands alone; and its age, because frequencies wander.

    Parameters
    ----------
    batches
        At least one, in the order of time.
    prior
        What is known of the frequency beforehand.
    bend
        See :class:`Line`.

    Returns
    -------
    tuple[Line, bool]
        The line, and whether it misses a synchronisation by more than the scatter of its stamps explains: the clock's
        frequency has changed, so the line should not reach back so far.
    """
    origin_ns, base_ns = int(batches[-1].station_ns[-1]), int(batches[-1].offset_ns[-1])
    t = np.concatenate([(b.station_ns - origin_ns) / 1e9 for b in batches])
    y = np.concatenate([(b.offset_ns - base_ns).astype(np.float64) for b in batches])
    excess_ns = np.concatenate([b.excess_ns for b in batches]).astype(np.float64)
    counts = [len(batch.station_ns) for batch in batches]
    starts = np.cumsum([0, *counts[:-1]])
    slowness = 1 + ((excess_ns - excess_ns.min()) / _HALF_WEIGHT_EXCESS_NS) ** 2
    doubts_ns = np.array([batch.doubt_ns for batch in batches])
    # What all stamps of a synchronisation share weighs as much for all of them as for one.
    ages_s = t[np.cumsum(counts) - 1]
    shared = doubts_ns**2 + (_USUAL_WANDER_NS_PER_S2 * ages_s**2 / 2) ** 2
    shared = np.repeat(shared * counts, counts)

    noise_ns = _USUAL_NOISE_NS
    for _ in range(3):  # the noise depends on the line, a little
        w = 1 / (noise_ns**2 * slowness + shared)
        a, b, c = w.sum(), w @ t, w @ t**2 + prior.sigma**-2
        p, q = w @ y, w @ (t * y) + prior.mean / prior.sigma**2
        determinant = a * c - b * b
        offset_ns, frequency = (c * p - b * q) / determinant, (a * q - b * p) / determinant
        residuals = y - offset_ns - frequency * t
        weights = np.add.reduceat(1 / slowness, starts)
        means = np.add.reduceat(residuals / slowness, starts) / weights
        scatter = residuals**2 / slowness
        noise_ns = math.sqrt(_noise(float(scatter.sum() - weights @ means**2), len(t) - len(batches)))
    # Three standard errors, and half as much again because the scatter need not follow the weights.
    allowed = 4.5 * noise_ns / np.sqrt(weights) + _USUAL_NOISE_NS + doubts_ns
    excused = max(float(w @ residuals**2) / len(t), 1.0)
    sure = confirmed(batches)
    line = Line(
        origin_ns=origin_ns,
        base_ns=base_ns,
        offset_ns=float(offset_ns),
        frequency=float(frequency),
        variances=(excused * c / determinant, -excused * b / determinant, excused * a / determinant),
        since_s=float(sure[0].station_ns[0] - origin_ns) / 1e9,
        until_s=float(sure[-1].station_ns[-1] - origin_ns) / 1e9,
        least_excess_ns=float(np.abs(excess_ns).min()),
        gap_s=gap_s(sure),
        noise_ns=noise_ns,
        bend=bend,
    )
    return line, bool((np.abs(means) > allowed).any())


def _noise(sum_of_squares: float, freedom: int) -> float:
    """Return the variance of stamps in ns^2; what they usually have counts as a few more of them."""
    known = _USUAL_NOISE_WEIGHT * _USUAL_NOISE_NS**2
    return (known + sum_of_squares) / (_USUAL_NOISE_WEIGHT + max(freedom, 0))
