"""When an instrument measures: at even intervals, found from the stamps of its measurements.

Measurements get lost, come late and out of turn, and some instruments take a few milliseconds more or less each time.
So the interval is first guessed from the shorter steps between neighbours, which numbers the measurements, and then
fitted by least squares, once with all of them and once without those that lie far off.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise
from statistics import fmean, median
from typing import NamedTuple

MOST = 24
"""Measurements that are looked at: some ten seconds, short enough to follow any clock."""

LEAST = 6
"""Fewer do not tell an interval."""

LONGEST_GAP_US = 5_000_000
"""After so long without a measurement an instrument may have started anew, so that nothing of before holds."""

LARGEST_SPREAD = 0.1
"""An instrument that is off its beat by more than this part of its period keeps none."""

_OUTLYING = 4.0
_LEAST_OUTLYING_US = 500.0


class Beat(NamedTuple):
    """At which instants an instrument measures.

    Attributes
    ----------
    period_us
        From one measurement to the next.
    phase_us
        One of the instants, at or near the newest measurement.
    spread_us
        By how much single measurements are off, one sigma.
    """

    period_us: float
    phase_us: float
    spread_us: float


class Rhythm:
    """The beat of one instrument.

    Attributes
    ----------
    beat
        As the measurements up to now show it; None while they show none.
    newest_us
        The newest measurement; None before the first.
    """

    def __init__(self) -> None:
        self._times_us: list[int] = []
        self.beat: Beat | None = None

    @property
    def newest_us(self) -> int | None:
        """When the newest measurement was made."""
        return self._times_us[-1] if self._times_us else None

    def add(self, time_us: int) -> None:
        """Take a measurement; those that are known, or far older than the others, change nothing.

        Parameters
        ----------
        time_us
            When it was made, on any even clock.
        """
        times = self._times_us
        if times and time_us > times[-1] + LONGEST_GAP_US:
            times.clear()
        place = bisect_left(times, time_us)
        if times[place : place + 1] == [time_us] or (times and time_us < times[-1] - LONGEST_GAP_US):
            return
        times.insert(place, time_us)
        del times[:-MOST]
        self.beat = _beat(times)
        if self.beat is None and len(times) == MOST:
            del times[: MOST // 2]  # what came before a change of beat only hides the new one


def _beat(times_us: list[int]) -> Beat | None:
    if len(times_us) < LEAST:
        return None
    steps = [after - before for before, after in pairwise(times_us)]
    usual = sorted(steps)[len(steps) // 4]  # where some are missing, longer steps are several intervals
    numbers = [0]
    for step in steps:
        numbers.append(numbers[-1] + max(round(step / usual), 1))
    points = [
        (number - numbers[-1], float(time - times_us[-1]))
        for number, time in zip(numbers, times_us, strict=True)
    ]
    fit = _line(points)
    misses = _misses(points, fit)
    limit_us = max(_OUTLYING * median(misses), _LEAST_OUTLYING_US)
    kept = [point for point, miss in zip(points, misses, strict=True) if miss <= limit_us]
    phase_us, period_us = fit = _line(kept)
    spread_us = fmean([miss * miss for miss in _misses(kept, fit)]) ** 0.5
    if spread_us > LARGEST_SPREAD * period_us:
        return None
    return Beat(period_us, times_us[-1] + phase_us, spread_us)


def _misses(points: list[tuple[int, float]], fit: tuple[float, float]) -> list[float]:
    start, slope = fit
    return [abs(time - start - slope * number) for number, time in points]


def _line(points: list[tuple[int, float]]) -> tuple[float, float]:
    """Return value at number 0, and slope."""
    middle, mean = fmean([number for number, _ in points]), fmean([time for _, time in points])
    slope = sum([(number - middle) * (time - mean) for number, time in points]) / sum(
        [(number - middle) ** 2 for number, _ in points]
    )
    return mean - slope * middle, slope
