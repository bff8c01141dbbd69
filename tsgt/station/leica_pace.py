"""When to ask a tracking instrument for its next distance."""

from __future__ import annotations

from collections import deque
from typing import Final

_INTERVALS: Final = 16
_FEWEST: Final = 4
_EARLY_NS: Final = 10_000_000
"""So long before the next distance can be there it is asked for: instruments are not quite even."""

_PROBE_EVERY: Final = 24
"""After so many distances one interval is asked through without a pause, to see whether they come more often by now."""

IDLE_NS: Final = 100_000_000
"""Between two questions that bring no distance."""


class Pace:
    """Learns from distances' times how often they come.

    An instrument that has a distance already answers with that one again and again. Where they come slower than it
    answers, most questions would be for nothing.
    """

    def __init__(self) -> None:
        self._last_ms: int | None = None
        self._intervals_ms: deque[int] = deque(maxlen=_INTERVALS)
        self._count = 0

    @property
    def interval_ns(self) -> int | None:
        """The least time between two distances lately; None where it is not known."""
        return min(self._intervals_ms) * 1_000_000 if len(self._intervals_ms) >= _FEWEST else None

    def distance(self, instrument_ms: int) -> None:
        """Note a new distance."""
        if self._last_ms is not None:
            interval_ms = instrument_ms - self._last_ms
            if 0 < interval_ms < 5_000:
                self._intervals_ms.append(interval_ms)
        self._last_ms = instrument_ms
        self._count += 1

    def next_ns(self, distance_ns: int, round_trip_ns: int) -> int:
        """Return when to ask for the distance after one; 0: at once.

        Parameters
        ----------
        distance_ns
            When the fastest answer with that one could have come.
        round_trip_ns
            From a question to the fastest answer.
        """
        interval_ns = self.interval_ns
        if interval_ns is None or self._count % _PROBE_EVERY == 0:
            return 0
        return distance_ns + interval_ns - round_trip_ns - _EARLY_NS
