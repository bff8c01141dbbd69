"""Weighted regression of a station's clock offsets: sample selection, the line, and its bound.

The arithmetic of the filter ``regression`` in :mod:`tsgt.timesync.two_way`. Offsets are in ns, times in s from the last
exchange, skews in ns/s (1e-9, or 0.001 ppm).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tsgt.timesync.clock_line import ClockLine, pooled_variance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ClockSample

Int64s = NDArray[np.int64]
Floats = NDArray[np.float64]

PPM = 1000.0  # in ns/s

TIMESTAMP_FLOOR_NS = 100_000
"""Bound of a timestamp's error at best.

Interrupt to timestamp takes some microseconds; the delay of RxDone after a packet's end is known to about 0.05 symbols,
100 us at SF 9 and 250 kHz.
"""

UNKNOWN_SKEW_SIGMA = 30 * PPM
"""One sigma of a skew that was never measured: crystals of small computers agree to some tens of ppm."""

MAX_SKEW = 100 * PPM

# Bound of the wander: temperature changes a skew by 6 ppm in ten minutes, and by 20 ppm in all.
_MAX_WANDER_NS_PER_S2 = 0.01 * PPM
_MAX_SKEW_CHANGE = 20 * PPM

_USUAL_WANDER_NS_PER_S2 = 0.001 * PPM  # wander in the weights of past synchronisations

_HALF_WEIGHT_EXCESS_NS = 2_000_000  # an exchange slower than the fastest by this has half its weight

_PRIOR_NOISE_NS = 10_000.0
_PRIOR_NOISE_WEIGHT = 2

_SIGMAS_IN_BOUND = 4.0


@dataclass(frozen=True, slots=True)
class Batch:
    """The selected exchanges of one synchronisation: an entry each, at least one, in the order of time."""

    station_ns: Int64s
    offset_ns: Int64s  # see :attr:`~tsgt.model.ClockSample.max_offset_ns`
    excess_ns: Int64s

    @property
    def unconfirmed_ns(self) -> float:
        """How late the timestamp may be if it is the only one; several that agree confirm each other."""
        return abs(float(self.excess_ns[0])) if len(self.excess_ns) == 1 else 0.0


@dataclass(frozen=True, slots=True)
class SkewPrior:
    """Mean and one sigma, in ns/s."""

    mean: float
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RegressionLine:
    """Offset over station time, with its bound."""

    origin_ns: int  # station time of the last exchange
    base_ns: int  # offset to which the line's is added; offsets of whole years do not fit into a float
    line: ClockLine  # at the origin, in ns and ns/s
    since_s: float  # start of the span of the confirmed synchronisations; not above zero
    until_s: float  # its end; not above zero
    min_excess_ns: float
    gap_s: float  # how long the skew may have changed unobserved at the end of the span
    noise_ns: float  # scatter of the timestamps within a synchronisation, one sigma
    skew_error: float
    """Prediction error of the last synchronisation by the line before it, over the gap, in ns/s; not negative."""

    def at_ns(self, station_ns: int) -> int:
        """Return the offset at that station time."""
        return self.base_ns + round(self.line.offset_at(self._seconds(station_ns)))

    def sigma_ns(self, station_ns: int) -> float:
        """Return one sigma from the scatter of the timestamps."""
        return math.sqrt(max(self.line.variance_at(self._seconds(station_ns)), 0.0))

    def wander_ns(self, station_ns: int) -> float:
        """Return the bound of the error from a changing skew outside the span.

        A skew that changes by a each second shifts the offset by ``a t^2 / 2`` after t; a line through two points a gap
        apart is tangent to the middle between them, which makes it ``a t (t + gap) / 2``.
        """
        t = self._seconds(station_ns)
        outside_s = max(t - self.until_s, self.since_s - t, 0.0)
        change = min(_MAX_WANDER_NS_PER_S2 * (outside_s + self.gap_s) / 2, _MAX_SKEW_CHANGE)
        return outside_s * (change + self.skew_error)

    def uncertainty_ns(self, station_ns: int) -> float:
        """Return the bound of the error without a delay that all timestamps share."""
        return TIMESTAMP_FLOOR_NS + _SIGMAS_IN_BOUND * self.sigma_ns(station_ns) + self.wander_ns(station_ns)

    def prediction_error_ns(self, batch: Batch) -> float:
        """Return the median error of this line's prediction of a batch; not negative."""
        return abs(float(np.median(self._deviations_ns(batch))))

    def is_consistent(self, batch: Batch) -> bool:
        """Whether the offset intervals of a batch and of this line overlap; if not, the clock was set."""
        uncertainty_ns = self.uncertainty_ns(int(batch.station_ns[-1]))
        deviations_ns = self._deviations_ns(batch)
        lowest_ns = float((deviations_ns - batch.excess_ns).max())
        highest_ns = float(deviations_ns.min())
        return lowest_ns <= uncertainty_ns and highest_ns >= -uncertainty_ns - self.min_excess_ns

    def _deviations_ns(self, batch: Batch) -> Floats:
        predicted_ns = [self.at_ns(station_ns) for station_ns in batch.station_ns.tolist()]
        return (batch.offset_ns - np.array(predicted_ns, dtype=np.int64)).astype(np.float64)

    def _seconds(self, station_ns: int) -> float:
        return (station_ns - self.origin_ns) / 1e9


def interpolation_wander_ns(since_s: float, until_s: float) -> float:
    """Return the bound of an offset's deviation from the straight line between two known ones, in ns.

    A skew that changes by a each second bends the line by ``a s u / 2`` at s after the one and u before the other.
    """
    return since_s * until_s * min(_MAX_WANDER_NS_PER_S2 / 2, _MAX_SKEW_CHANGE / max(since_s + until_s, 1e-9))


def select_samples(samples: Sequence[ClockSample], skew: float, noise_ns: float | None = None) -> Batch:
    """Drop the exchanges of a synchronisation that are impossible, precede a step, or have late timestamps.

    Parameters
    ----------
    samples
        At least one, in the order of time.
    skew
        Prior in ns/s; ten samples or more have their own.
    noise_ns
        One sigma of the timestamps if known; a few of them do not show it.
    """
    possible = [s for s in samples if s.excess_ns >= -TIMESTAMP_FLOOR_NS] or samples
    usable = _after_last_step(possible)
    station_ns = np.array([s.station_ns for s in usable], dtype=np.int64)
    offset_ns = np.array([s.max_offset_ns for s in usable], dtype=np.int64)
    excess_ns = np.array([s.excess_ns for s in usable], dtype=np.int64)
    t = (station_ns - station_ns[-1]) / 1e9
    y = (offset_ns - offset_ns[-1]).astype(np.float64)
    if len(usable) >= 10:
        skew = _theil_sen_slope(t, y)
    # A delay only raises an offset, so the lowest offsets are punctual: the lowest one within the known noise, or the
    # lowest quarter within its own spread.
    detrended = y - skew * t
    lowest, quarter = np.quantile(detrended, [0.0, 0.25])
    limit = quarter + 4 * (quarter - lowest) if noise_ns is None else lowest + 6 * noise_ns
    kept = detrended <= max(limit, lowest + TIMESTAMP_FLOOR_NS / 2)
    return Batch(station_ns[kept], offset_ns[kept], excess_ns[kept])


def _theil_sen_slope(t: Floats, y: Floats) -> float:
    """Return the median of all pairs' slopes, robust against a quarter of late timestamps (Sen 1968)."""
    first, second = np.triu_indices(len(t), 1)
    run = t[second] - t[first]
    return float(np.median((y[second] - y[first])[run > 0] / run[run > 0])) if (run > 0).any() else 0.0


def _after_last_step(samples: Sequence[ClockSample]) -> Sequence[ClockSample]:
    """Return the newest exchanges that one clock can have made: their offset intervals have a point in common."""
    newest = samples[-1]
    lowest_ns, highest_ns = -math.inf, math.inf
    for index in reversed(range(len(samples))):
        sample = samples[index]
        tolerance_ns = TIMESTAMP_FLOOR_NS + MAX_SKEW * (newest.sent_ns - sample.sent_ns) / 1e9
        lowest_ns = max(lowest_ns, sample.min_offset_ns - newest.max_offset_ns - tolerance_ns)
        highest_ns = min(highest_ns, sample.max_offset_ns - newest.max_offset_ns + tolerance_ns)
        if lowest_ns > highest_ns:
            return samples[index + 1 :]
    return samples


def confirmed(batches: Sequence[Batch]) -> Sequence[Batch]:
    """Return the synchronisations whose timestamps confirm each other, or all if there is none."""
    return [batch for batch in batches if batch.unconfirmed_ns == 0] or batches


def gap_s(batches: Sequence[Batch]) -> float:
    """Return the time from the last but one synchronisation to the end of the last, or the duration of the only one."""
    newest = batches[-1].station_ns
    since_ns = batches[-2].station_ns[-1] if len(batches) > 1 else newest[0]
    return max(float(newest[-1] - since_ns) / 1e9, 1.0)


def fit_line(batches: Sequence[Batch], prior: SkewPrior, skew_error: float) -> tuple[RegressionLine, bool]:
    """Fit the line by weighted least squares, with the prior of the skew as one more observation.

    An offset's variance has three parts: the noise of the timestamps, from their scatter within synchronisations, less
    for fast round trips; the possible delay of a timestamp that is the only one; and its age, because skews wander.
    Returns the line, and whether a synchronisation's mean residual exceeds what the noise explains: the skew has
    changed, so the line should not reach back so far.

    Parameters
    ----------
    batches
        At least one, in the order of time.
    prior
        Of the skew.
    skew_error
        See :class:`RegressionLine`.
    """
    origin_ns, base_ns = int(batches[-1].station_ns[-1]), int(batches[-1].offset_ns[-1])
    t = np.concatenate([(b.station_ns - origin_ns) / 1e9 for b in batches])
    y = np.concatenate([(b.offset_ns - base_ns).astype(np.float64) for b in batches])
    excess_ns = np.concatenate([b.excess_ns for b in batches]).astype(np.float64)
    counts = [len(batch.station_ns) for batch in batches]
    starts = np.cumsum([0, *counts[:-1]])
    slowness = 1 + ((excess_ns - excess_ns.min()) / _HALF_WEIGHT_EXCESS_NS) ** 2
    unconfirmed_ns = np.array([batch.unconfirmed_ns for batch in batches])
    # A variance that all timestamps of a synchronisation share weighs as much for all of them as for one.
    ages_s = t[np.cumsum(counts) - 1]
    shared = unconfirmed_ns**2 + (_USUAL_WANDER_NS_PER_S2 * ages_s**2 / 2) ** 2
    shared = np.repeat(shared * counts, counts)

    noise_ns = _PRIOR_NOISE_NS
    for _ in range(3):  # the noise depends on the line, a little
        w = 1 / (noise_ns**2 * slowness + shared)
        a, b, c = w.sum(), w @ t, w @ t**2 + prior.sigma**-2
        p, q = w @ y, w @ (t * y) + prior.mean / prior.sigma**2
        determinant = a * c - b * b
        offset_ns, skew = (c * p - b * q) / determinant, (a * q - b * p) / determinant
        residuals = y - offset_ns - skew * t
        weights = np.add.reduceat(1 / slowness, starts)
        means = np.add.reduceat(residuals / slowness, starts) / weights
        squares = residuals**2 / slowness
        variance = pooled_variance(
            float(squares.sum() - weights @ means**2),
            max(len(t) - len(batches), 0),
            prior_sigma=_PRIOR_NOISE_NS,
            prior_weight=_PRIOR_NOISE_WEIGHT,
        )
        noise_ns = math.sqrt(variance)
    # Three standard errors, and half as much again because the scatter need not follow the weights.
    tolerances = 4.5 * noise_ns / np.sqrt(weights) + _PRIOR_NOISE_NS + unconfirmed_ns
    inflation = max(float(w @ residuals**2) / len(t), 1.0)
    sure = confirmed(batches)
    line = RegressionLine(
        origin_ns=origin_ns,
        base_ns=base_ns,
        line=ClockLine(
            float(offset_ns),
            float(skew),
            inflation * c / determinant,
            -inflation * b / determinant,
            inflation * a / determinant,
        ),
        since_s=float(sure[0].station_ns[0] - origin_ns) / 1e9,
        until_s=float(sure[-1].station_ns[-1] - origin_ns) / 1e9,
        min_excess_ns=float(np.abs(excess_ns).min()),
        gap_s=gap_s(sure),
        noise_ns=noise_ns,
        skew_error=skew_error,
    )
    return line, bool((np.abs(means) > tolerances).any())
