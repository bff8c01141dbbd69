"""Period and phase of an instrument's continuous measurement, from the timestamps of its measurements.

Some get lost, late, out of order, or jitter by milliseconds: a rough period from the shorter intervals numbers them, and
least squares fits period and phase, once with all and once without outliers.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise
from statistics import fmean, median
from typing import NamedTuple

MAX_MEASUREMENTS = 24  # measurements that are used: about ten seconds, short enough to follow any clock

MIN_MEASUREMENTS = 6

MAX_GAP_US = 5_000_000
"""After a longer gap the instrument may have restarted: earlier measurements are dropped."""

MAX_RELATIVE_JITTER = 0.1  # an instrument whose jitter exceeds this part of its period has none

_OUTLIER_MEDIANS = 4.0
_MIN_OUTLIER_US = 500.0


class Period(NamedTuple):
    """When an instrument measures.

    Attributes
    ----------
    period_us
        From one measurement to the next.
    phase_us
        Time of one of them, at or near the newest.
    jitter_us
        One sigma of a single measurement.
    """

    period_us: float
    phase_us: float
    jitter_us: float


class Periodicity:
    """Estimates the period of one instrument; ``period`` is None while there is none."""

    def __init__(self) -> None:
        self._times_us: list[int] = []
        self.period: Period | None = None

    @property
    def newest_us(self) -> int | None:
        """Time of the newest measurement; None before the first."""
        return self._times_us[-1] if self._times_us else None

    def add(self, time_us: int) -> None:
        """Take the time of a measurement, in any order, on any uniform clock; repeated and far older ones are ignored."""
        times = self._times_us
        if times and time_us > times[-1] + MAX_GAP_US:
            times.clear()
        place = bisect_left(times, time_us)
        if times[place : place + 1] == [time_us] or (times and time_us < times[-1] - MAX_GAP_US):
            return
        times.insert(place, time_us)
        del times[:-MAX_MEASUREMENTS]
        self.period = _fit(times)
        if self.period is None and len(times) == MAX_MEASUREMENTS:
            del times[: MAX_MEASUREMENTS // 2]  # measurements before a change of period hide the new one


def _fit(times_us: list[int]) -> Period | None:
    if len(times_us) < MIN_MEASUREMENTS:
        return None
    intervals = [after - before for before, after in pairwise(times_us)]
    rough = sorted(intervals)[len(intervals) // 4]  # intervals with lost measurements are multiples of it
    numbers = [0]
    for interval in intervals:
        numbers.append(numbers[-1] + max(round(interval / rough), 1))
    points = [
        (number - numbers[-1], float(time - times_us[-1]))
        for number, time in zip(numbers, times_us, strict=True)
    ]
    line = _least_squares(points)
    residuals = _residuals(points, line)
    limit_us = max(_OUTLIER_MEDIANS * median(residuals), _MIN_OUTLIER_US)
    kept = [point for point, residual in zip(points, residuals, strict=True) if residual <= limit_us]
    phase_us, period_us = line = _least_squares(kept)
    jitter_us = fmean([residual * residual for residual in _residuals(kept, line)]) ** 0.5
    if jitter_us > MAX_RELATIVE_JITTER * period_us:
        return None
    return Period(period_us, times_us[-1] + phase_us, jitter_us)


def _residuals(points: list[tuple[int, float]], line: tuple[float, float]) -> list[float]:
    intercept, slope = line
    return [abs(time - intercept - slope * number) for number, time in points]


def _least_squares(points: list[tuple[int, float]]) -> tuple[float, float]:
    """Return intercept and slope of the regression line."""
    mean_number, mean_time = fmean([number for number, _ in points]), fmean([time for _, time in points])
    slope = sum([(number - mean_number) * (time - mean_time) for number, time in points]) / sum(
        [(number - mean_number) ** 2 for number, _ in points]
    )
    return mean_time - slope * mean_number, slope
