"""When each sample ends and how long it lasts, on the device's own clock, with what was lost between. Sans-I/O.

Durations never come from arrivals: the rotation over a sample is its rate times its duration, and delays of 1 ms in the
durations would triple the error of the position.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

_REMEMBERED = 512  # samples that are recognised when they are printed again

_MIN_REPEATED, _MAX_REPEATED = 50, 256
"""Bounds of the number of known samples in succession that shows that the device has begun again: all since it began. Fewer may be a line
that is printed again.
"""

_BASELINE = 1000  # samples after which the period is known to 1e-5 and better

_GAP_TOLERANCE_NS = 2e6
_GAP_TOLERANCE = 1e-4
"""By how much the clock may disagree with the counter over a gap, plus this share of it; beyond, it was set meanwhile. After fewer samples
the share grows with the square of what is missing: whole milliseconds tell the period of 50 samples to half a percent.
"""

_MAX_STEPS = 1e7  # a count that is further ahead is not a gap of samples


class SampleTime(NamedTuple):
    """One sample on the device's clock.

    Attributes
    ----------
    end_ns
        End of its interval; only differences are meaningful, and only while ``restarted`` is not set.
    duration_ns
        Length of the interval.
    lost
        Number of samples that the device made between the one before and this one.
    restarted
        Whether clock or counter have been set, or have begun again: earlier times have another origin.
    """

    end_ns: int
    duration_ns: int
    lost: int
    restarted: bool


class SampleTimes:
    """Follows counter and clock of one device; ``rate_hz`` is its nominal rate."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = 1e9 / rate_hz
        self._last: tuple[int | None, int | None] | None = None
        self._origin: tuple[int, int] | None = (
            None  # counter and clock of the first sample since the last restart
        )
        self._recent: deque[tuple[int | None, int | None]] = deque(maxlen=_REMEMBERED)
        self._count = self._repeated = 0  # samples since the last restart, and repeats in succession

    def push(self, counter: int | None, instrument_time_ns: int | None) -> SampleTime | None:
        """Take the next sample, with at least one of both; None for a recent sample once more."""
        found = self._push(counter, instrument_time_ns)
        if found is not None and found.restarted:
            self._count = 0
            given = counter is not None and instrument_time_ns is not None
            self._origin = (counter or 0, instrument_time_ns or 0) if given else None
        self._count += found is not None
        return found

    def _push(self, counter: int | None, instrument_time_ns: int | None) -> SampleTime | None:
        sample = (counter, instrument_time_ns)
        last = self._last
        if last is not None and _not_after(sample, last) and sample in self._recent:
            # A device that is asked more often than it measures repeats the newest one.
            self._repeated += sample != last
            return None
        began_again = self._repeated >= min(max(self._count - 1, _MIN_REPEATED), _MAX_REPEATED)
        self._repeated = 0
        self._last = sample
        self._recent.append(sample)
        period_ns = round(self._period_ns)
        end_ns = round((counter or 0) * self._period_ns) if instrument_time_ns is None else instrument_time_ns
        restart = SampleTime(end_ns, period_ns, 0, restarted=True)
        if last is None or began_again:
            return restart
        before, time_before_ns = last
        if (before is None) != (counter is None) or (time_before_ns is None) != (instrument_time_ns is None):
            return restart
        steps = None if counter is None or before is None else counter - before
        if instrument_time_ns is None or time_before_ns is None:
            assert steps is not None  # noqa: S101 (one of both is given)
            duration_ns = period_ns
        else:
            span_ns = instrument_time_ns - time_before_ns
            if span_ns <= 0:
                return restart
            if steps is None:
                steps = max(1, round(span_ns / self._period_ns))
            elif steps > 0 and (
                not 0.5 < span_ns / (steps * self._period_ns) < 1.5
                or (steps > 1 and self._set_in_gap(sample, last))
            ):  # the clock was set
                return restart
            duration_ns = round(span_ns / steps) if steps > 0 else period_ns
        if not 0 < steps <= _MAX_STEPS:
            return restart
        return SampleTime(end_ns, duration_ns, steps - 1, restarted=False)

    def _set_in_gap(self, sample: tuple[int | None, int | None], last: tuple[int | None, int | None]) -> bool:
        """Whether the clock was set during a gap: it disagrees with the counter times the period of the samples before.

        A gap of ten seconds hides a step of one second from the nominal period. A clock that is set back in it would
        look like samples that arrive late.
        """
        (counter, time_ns), (before, time_before_ns), origin = sample, last, self._origin
        if counter is None or time_ns is None or before is None or time_before_ns is None or origin is None:
            return False
        count = before - origin[0]
        if count < 1:
            return False
        share = _GAP_TOLERANCE * max(1.0, _BASELINE / count) ** 2
        expected_ns = (counter - before) * (time_before_ns - origin[1]) / count
        error_ns = abs(time_ns - time_before_ns - expected_ns)
        return error_ns > _GAP_TOLERANCE_NS + share * expected_ns


def _not_after(sample: tuple[int | None, int | None], last: tuple[int | None, int | None]) -> bool:
    return any(
        new is not None and old is not None and new <= old for new, old in zip(sample, last, strict=True)
    )
