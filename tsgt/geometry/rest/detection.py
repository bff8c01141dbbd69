"""Detection of rest: intervals in which the robot stands still, found from the measurements alone. Sans-I/O.

The prisms of a robot at rest stay where they are: each series of measurements (of one prism by one station) has a constant
mean, whatever the errors of station frames and layout, and one series is enough. Windows of a few seconds are tested for a
trend and for serial correlation against the scatter within the window: an engine may shake the robot, as long as that is
white at the rate of the measurements. See docs/explanation/continuous-trajectory.md, "Rest".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import chdtri, fdtri

from tsgt.geometry.polar import cartesian_to_polar
from tsgt.geometry.rest.factors import RestInterval

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations

WINDOWS_S = (2.0, 2.5, 3.0, 4.0, 6.0, 9.0)
"""Lengths of the windows that are tested: the shortest one that can tell a creep (:data:`MIN_CREEP_CHI2`)."""

CREEP_MPS = 5e-3
MIN_CREEP_CHI2 = 60.0
"""A window can tell a creep if :data:`CREEP_MPS`, in the direction that is measured worst, adds this much to the chi-square of
the trends. Its limit is about 20 for three series: one window of such a robot in 10,000 then looks like rest."""

TREND_SIGNIFICANCE = 0.03  # A window of rest that fails costs little: the windows overlap
MIN_WHITENESS_SIGMAS = 3.0
STEADY_WINDOWS_S = (6.0, 9.0)  # Within a run of shorter ones that look like rest: these tell a slow sway
WANDER_MPS = 1e-3  # Trend that is allowed in them: a robot sinks into snow
MAX_VIBRATION_M = 4e-3
MIN_SCATTER = 0.25  # Variance over the stated one; less is taken for chance
MAX_GAP_S = 1.0  # Between successive measurements of any prism
MARGIN_S = 0.3  # A robot has moved before that shows; this much earlier a smooth start is below a tenth of it
END_S = 1.2  # Part of an interval at either end that is compared with the rest of it
END_SIGNIFICANCE = 1e-3
MIN_DURATION_S = 1.0  # Of what remains without the margins
_HAMPEL_SIGMAS, _HAMPEL_VIBRATIONS = 6.0, 4.0
_CHUNK = 4096


@dataclass(frozen=True, slots=True)
class Series:
    """M coordinate triples of prisms in the order of time, each coordinate with independent noise."""

    time_s: FloatArray  # (M,)
    series: NDArray[np.intp]  # (M,) measurements of one prism by one station have the same number
    values: FloatArray  # (M, 3) in any unit
    sigmas: FloatArray  # (M, 3) in the same units
    sigmas_m: FloatArray  # (M, 3) the same as lengths

    def __len__(self) -> int:
        return len(self.time_s)

    @classmethod
    def of(cls, observations: Observations) -> Series:
        """Take the raw coordinates of measurements: only their noise is independent."""
        points_m, sigmas_m, polar = observations.points_m, observations.sigmas_m, observations.polar
        numbers = observations.station * len(observations.layout) + observations.prism
        series = np.unique(numbers, return_inverse=True)[1].astype(np.intp)
        values, sigmas = points_m.copy(), sigmas_m.copy()
        horizontal_rad, zenith_rad, distance_m = cartesian_to_polar(points_m[polar])
        for number in np.unique(series[polar]):
            rows = series[polar] == number
            horizontal_rad[rows] = np.unwrap(horizontal_rad[rows])
        values[polar] = np.stack([distance_m, horizontal_rad, zenith_rad], axis=1)
        sigmas[polar, 1] /= np.maximum(np.hypot(points_m[polar, 0], points_m[polar, 1]), 1e-3)
        sigmas[polar, 2] /= np.maximum(distance_m, 1e-3)
        return cls(observations.time_s, series, values, sigmas, sigmas_m)

    def select(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Series:
        """Return the measurements of some rows."""
        return Series(*(getattr(self, name)[rows] for name in Series.__slots__))


def find_rest(observations: Observations) -> list[RestInterval]:
    """Find the intervals in which the robot stands still, in the order of time, from measurements in the order of time."""
    return find_rest_in_series(Series.of(observations))


def find_rest_in_series(series: Series) -> list[RestInterval]:
    """Find the intervals in which no prism moves, in the order of time."""
    series = series.select(~_outliers(series))
    found = []
    for start, stop in _runs(_window_ends(series)):
        run = _without_moved_ends(series.select(slice(start, stop)))
        for steady in _steady_runs(run):
            part = run.select(slice(*steady))
            start_s, end_s = float(part.time_s[0]) + MARGIN_S, float(part.time_s[-1]) - MARGIN_S
            if end_s - start_s >= MIN_DURATION_S:
                found.append(RestInterval(start_s, end_s, _vibration_m(part)))
    return found


def _outliers(series: Series) -> NDArray[np.bool_]:
    """Whether single measurements are far from the median of five of their series: a motion that lasts moves the median."""
    outliers = np.zeros(len(series), np.bool_)
    for number in np.unique(series.series):
        rows = np.flatnonzero(series.series == number)
        if len(rows) < 5:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(series.values[rows], 5, axis=0)
        median = np.sort(windows, axis=-1)[..., 2]
        limit = np.maximum(_HAMPEL_SIGMAS, _HAMPEL_VIBRATIONS * MAX_VIBRATION_M / series.sigmas_m[rows[2:-2]])
        far = np.abs(series.values[rows[2:-2]] - median) > limit * series.sigmas[rows[2:-2]]
        outliers[rows[2:-2]] = far.any(axis=1)
    return outliers


def _runs(window_ends: NDArray[np.intp]) -> Iterator[tuple[int, int]]:
    """Slices of rows that overlapping windows of rest cover."""
    start = stop = 0
    for first in np.flatnonzero(window_ends).tolist():
        if first >= stop:
            if stop:
                yield start, stop
            start = first
        stop = max(stop, int(window_ends[first]))
    if stop:
        yield start, stop


def _window_ends(series: Series) -> NDArray[np.intp]:
    """(M,) last row plus one of the window of rest that begins with each measurement; 0: there is none."""
    count = len(series)
    ends = np.zeros(count, np.intp)
    for first in range(0, count, _CHUNK):
        starts = np.arange(min(_CHUNK, count - first))
        last_s = series.time_s[first + starts[-1]] + WINDOWS_S[-1] + MAX_GAP_S
        windows = _Windows(series.select(slice(first, int(np.searchsorted(series.time_s, last_s)))))
        for length_s in WINDOWS_S:
            stops = windows.stops(starts, length_s)
            starts, stops = starts[stops > 0], stops[stops > 0]
            conclusive, at_rest = windows.test(starts, stops)
            ends[first + starts[at_rest]] = first + stops[at_rest]
            starts = starts[~conclusive]
            if not len(starts):
                break
    return ends


class _Windows:
    """Tests of any windows of measurements, from cumulative sums by series."""

    def __init__(self, series: Series) -> None:
        count, number = len(series), int(series.series.max()) + 1
        rows, own = np.arange(count), series.series
        weights, values = series.sigmas**-2.0, series.values.copy()
        steps = np.zeros((count, 3))
        self._next = np.full((count + 1, number), count)  # First row of each series from a row on
        for each in range(number):
            of_each = rows[own == each]
            if not len(of_each):
                continue
            values[of_each] -= _median(values[of_each])
            variances = series.sigmas[of_each] ** 2
            steps[of_each[1:]] = np.diff(values[of_each], axis=0) ** 2 / (variances[1:] + variances[:-1])
            self._next[:, each] = np.append(of_each, count)[np.searchsorted(of_each, np.arange(count + 1))]
        self._time_s = time_s = series.time_s
        t = (time_s - time_s[0])[:, None]
        terms = np.stack(
            (
                np.ones((count, 3)),
                *(weights * each for each in (np.ones_like(t), t, t**2, values, t * values, values**2)),
                steps,
                series.sigmas_m**-2.0,
                series.sigmas**2 / series.sigmas_m**2,
            )
        )
        self._sums = np.zeros((len(terms), count + 1, number, 3))
        self._sums[:, rows + 1, own] = terms
        np.cumsum(self._sums, axis=1, out=self._sums)
        self._gaps = np.concatenate([[0, 0], np.cumsum(np.diff(time_s) > MAX_GAP_S)])

    def stops(self, starts: NDArray[np.intp], length_s: float) -> NDArray[np.intp]:
        """Row after each window of at least this length; 0 where there is a gap or the measurements end."""
        stops = np.searchsorted(self._time_s, self._time_s[starts] + length_s) + 1
        complete = stops <= len(self._time_s)
        stops = np.where(complete, stops, 1)
        return np.where(complete & (self._gaps[stops] == self._gaps[starts + 1]), stops, 0)

    def test(
        self, starts: NDArray[np.intp], stops: NDArray[np.intp]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Whether windows could tell a creep, and whether they can and the robot was at rest in them."""
        found = self._statistics(starts, stops)
        conclusive = CREEP_MPS**2 * found.creep >= MIN_CREEP_CHI2 * found.scatter
        white = _is_white(found.steps, found.about_mean, found.freedom)
        weak = found.vibration_m2 < MAX_VIBRATION_M**2
        return conclusive, conclusive & (found.trend < found.trend_limit) & white & weak

    def steady(self, starts: NDArray[np.intp], stops: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether the motion in windows is a slow wander at most: neither faster nor swaying."""
        found = self._statistics(starts, stops)
        slow = found.trend < found.trend_limit + WANDER_MPS**2 * found.creep
        return slow & _is_white(found.steps, found.about_mean - found.trend, found.freedom)

    def _statistics(self, starts: NDArray[np.intp], stops: NDArray[np.intp]) -> _Statistics:
        number, w, wt, wtt, wy, wty, wyy, _, precision, units = self._sums[:, stops] - self._sums[:, starts]
        # The first step of each series begins before the window.
        first = np.minimum(self._next[starts] + 1, stops[:, None])
        series = np.arange(number.shape[1])
        steps = self._sums[7][stops] - self._sums[7][first, series]
        used = number >= 3
        safe_w = np.where(used, w, 1.0)
        spread = np.where(used, wtt - wt**2 / safe_w, 1.0)
        trend = np.where(used, (wty - wt * wy / safe_w) ** 2 / spread, 0.0).sum(axis=(1, 2))
        about_mean = np.where(used, wyy - wy**2 / safe_w, 0.0).sum(axis=(1, 2))

        def total(each: FloatArray) -> FloatArray:
            return np.asarray(np.where(used, each, 0.0).sum(axis=(1, 2)))

        trends, freedom = np.maximum(used.sum(axis=(1, 2)), 1), total(number - 1.0)
        remaining = np.maximum(freedom - trends, 1.0)
        variance = (about_mean - trend) / remaining
        scatter = np.maximum(variance, MIN_SCATTER)
        return _Statistics(
            trend,
            scatter * trends * _trend_quantiles(trends, remaining),
            about_mean,
            total(steps),
            freedom,
            scatter,
            np.where(used, spread * units / np.maximum(number, 1), 0.0).sum(axis=1).min(axis=1),
            (variance - 1.0) / np.maximum(total(precision) / np.maximum(total(number), 1.0), 1e-9),
        )


class _Statistics(NamedTuple):
    """Statistics of N windows, (N,) each."""

    trend: FloatArray  # Chi-square of the trends
    trend_limit: FloatArray
    about_mean: FloatArray  # Chi-square of the scatter about the means
    steps: FloatArray  # Sum of the squared, normalised differences of successive measurements
    freedom: FloatArray  # Of the last two
    scatter: FloatArray  # Variance about the trends over the stated one
    creep: FloatArray  # Chi-square that a speed of 1 m/s would add to the trends, in the direction that is measured worst
    vibration_m2: FloatArray


@lru_cache(maxsize=65536)
def _trend_quantile(trends: int, remaining: float) -> float:
    # The quantiles of F and chi-square themselves: the checks of scipy.stats cost several times as much.
    return float(fdtri(trends, remaining, 1.0 - TREND_SIGNIFICANCE))


def _trend_quantiles(trends: NDArray[np.intp], remaining: FloatArray) -> FloatArray:
    """Quantiles of F for numbers of trends and remaining degrees of freedom, (N,): few different ones, which are dear."""
    pairs = zip(trends.tolist(), remaining.tolist(), strict=True)
    return np.array([_trend_quantile(*each) for each in pairs], np.float64)


def _median(values: FloatArray) -> FloatArray:
    """Median of each column; for a few dozen rows a quarter of the time of numpy's."""
    ordered, count = np.sort(values, axis=0), len(values)
    median: FloatArray = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
    return median


def _is_white(steps: FloatArray, scatter: FloatArray, freedom: FloatArray) -> NDArray[np.bool_]:
    """Von Neumann's ratio: successive differences against the scatter, both about ``freedom`` if there is no correlation."""
    least = MIN_SCATTER * freedom  # Less is taken for chance, and nothing is left to be correlated
    ratio = np.maximum(steps, least) / np.maximum(scatter, least + 1e-9)
    white: NDArray[np.bool_] = ratio > 1.0 - MIN_WHITENESS_SIGMAS / np.sqrt(np.maximum(freedom, 1.0))
    return white


def _steady_runs(part: Series) -> Iterator[tuple[int, int]]:
    """Slices of the rows of a run that no long window contradicts: short ones do not tell a slow sway."""
    count = len(part)
    if count and abs(part.time_s[-1] - part.time_s[0]) < STEADY_WINDOWS_S[0]:
        yield 0, count
        return
    contradicted = np.zeros(count + 1, np.intp)
    for first in range(0, count, _CHUNK):
        starts = np.arange(min(_CHUNK, count - first))
        last_s = part.time_s[first + starts[-1]] + WINDOWS_S[-1] + MAX_GAP_S
        windows = _Windows(part.select(slice(first, int(np.searchsorted(part.time_s, last_s)))))
        for length_s in STEADY_WINDOWS_S:
            stops = windows.stops(starts, length_s)
            begun, ended = starts[stops > 0], stops[stops > 0]
            swaying = ~windows.steady(begun, ended)
            np.add.at(contradicted, first + begun[swaying], 1)
            np.add.at(contradicted, first + ended[swaying], -1)
    kept = np.concatenate([[False], np.cumsum(contradicted[:-1]) == 0, [False]])
    changes = np.flatnonzero(kept[1:] != kept[:-1]).tolist()
    yield from zip(changes[::2], changes[1::2], strict=True)


def _without_moved_ends(part: Series) -> Series:
    """Cut the measurements at either end that contradict the mean of the others."""
    for _ in range(2):
        # The end, then, backwards in time, the start.
        kept = len(part)
        while kept and (moved := _moved_from(part.select(slice(kept)))) < kept:
            kept = moved
        part = part.select(slice(kept))
        part = part.select(slice(None, None, -1))
    return part


def _moved_from(part: Series) -> int:
    """First row of the last ones that contradict the mean of the earlier; the number of rows if none do."""
    last_s = part.time_s[-1]
    end = np.flatnonzero(np.abs(part.time_s - last_s) <= min(END_S, np.abs(part.time_s[0] - last_s) / 2))
    distance, freedom = np.zeros(len(end)), np.zeros(len(end))
    for number in np.unique(part.series):
        own = part.series == number
        inner, outer = np.flatnonzero(own[: end[0]]), end[own[end]]
        if len(inner) < 2 or not len(outer):
            continue
        values, sigmas = part.values[inner], part.sigmas[inner]
        mean, variance = values.mean(axis=0), sigmas.mean(axis=0) ** 2
        variance = variance * max(float(((values - mean) ** 2 / variance).sum()) / (3 * len(inner) - 3), 1.0)
        # Means of the last one, the last two, ...
        counts = np.arange(len(outer), 0, -1)
        means = np.cumsum(part.values[outer][::-1], axis=0)[::-1] / counts[:, None]
        each = ((means - mean) ** 2 / (variance * (1 / counts + 1 / len(inner))[:, None])).sum(axis=1)
        place = np.searchsorted(outer, end)
        distance[place < len(outer)] += each[place[place < len(outer)]]
        freedom[place < len(outer)] += 3
    moved = distance > chdtri(np.maximum(freedom, 1), END_SIGNIFICANCE)
    return int(end[np.argmax(moved)]) if moved.any() else len(part)


def _vibration_m(part: Series) -> float:
    """One sigma of the scatter that the stated noise does not explain, in the coordinate in which it is largest.

    Only as far as it is significant: two standard deviations of the scatter's estimate are subtracted.
    """
    excess, freedom, precision = np.zeros(3), 0.0, np.zeros(3)
    for number in np.unique(part.series):
        own = part.select(part.series == number)
        excess += (((own.values - own.values.mean(axis=0)) / own.sigmas) ** 2).sum(axis=0) - (len(own) - 1)
        freedom += len(own) - 1
        precision += (own.sigmas_m**-2.0).sum(axis=0) * (1 - 1 / len(own))
    significant = (excess - 2.0 * np.sqrt(2.0 * freedom)) / np.maximum(precision, 1e-9)
    return float(np.sqrt(max(significant.max(), 0.0)))
