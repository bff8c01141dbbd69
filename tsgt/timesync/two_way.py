"""A station's clock against the master's, from two-way exchanges.

A positive offset means that the station's clock is ahead: a station timestamp less the offset is the master's time. An
exchange bounds it from both sides: the request cannot be timestamped before it arrived, nor after the reply
(:class:`~tsgt.model.ClockSample`). docs/explanation/clock-offset.md explains both filters and what is unobservable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

from tsgt.timesync.offset_regression import (
    MAX_SKEW,
    PPM,
    TIMESTAMP_FLOOR_NS,
    UNKNOWN_SKEW_SIGMA,
    RegressionLine,
    SkewPrior,
    confirmed,
    fit_line,
    gap_s,
    interpolation_wander_ns,
    select_samples,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ClockSample
    from tsgt.timesync.offset_regression import Batch

# A crystal survives the step or restart of the clock that counts its oscillations; its temperature does not.
_KEPT_SKEW_SIGMA = 3 * PPM
_UNKNOWN_SKEW = SkewPrior(0.0, UNKNOWN_SKEW_SIGMA)

_MAX_BATCHES = 12  # one hour of synchronisations every 300 s. Older ones say nothing about the present skew.

_MAX_WAIT_NS = 150_000_000
"""How long a measurement may wait in the station from its timestamp until the radio can send it."""

_FUTURE_TOLERANCE_NS = 10_000_000  # rounding of a timestamp: no measurement is made in the future


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """A station's clock against the master's at one instant.

    Attributes
    ----------
    offset_ns
        Positive when the station's clock is ahead.
    bound_ns
        The truth is within this of ``offset_ns``, delay asymmetry included.
    skew_ppm
        Positive when the station's clock runs fast; 0 where the filter does not estimate it.
    """

    offset_ns: int
    sigma_ns: int
    bound_ns: int
    skew_ppm: float


@dataclass(frozen=True, slots=True)
class FilterUpdate:
    """Result of a synchronisation: how many exchanges were rejected, and whether the filter was (re)initialised."""

    rejected: int
    restarted: bool


class ClockFilter(Protocol):
    """Follows the clock of one station from synchronisation to synchronisation."""

    name: str

    def update(self, samples: Sequence[ClockSample], *, may_have_restarted: bool = False) -> FilterUpdate:
        """Take one synchronisation's exchanges in order; ``may_have_restarted``: the station may have another clock."""
        ...

    def at(self, station_ns: int) -> ClockEstimate:
        """Return the offset at a time of the station's clock; raises LookupError without a synchronisation."""
        ...

    def reset(self) -> None:
        """Forget the offset: the station's clock was set or restarted."""
        ...


def clock_filter(name: Literal["regression", "paper"]) -> ClockFilter:
    """Return a new filter, for one station."""
    return RegressionFilter() if name == "regression" else PaperFilter()


def interpolate(
    before: ClockEstimate, before_ns: int, after: ClockEstimate, after_ns: int, station_ns: int
) -> ClockEstimate:
    """Return the offset on the line between two estimates and their station times, bounded by the skew's wander."""
    since_ns, until_ns = station_ns - before_ns, after_ns - station_ns
    share = since_ns / (since_ns + until_ns)
    wander_ns = interpolation_wander_ns(since_ns / 1e9, until_ns / 1e9)
    return ClockEstimate(
        before.offset_ns + round(share * (after.offset_ns - before.offset_ns)),
        # The wander is a bound; as a rule skews change by a third of it at most.
        round(math.hypot((1 - share) * before.sigma_ns + share * after.sigma_ns, wander_ns / 3)),
        math.ceil((1 - share) * before.bound_ns + share * after.bound_ns + wander_ns),
        (after.offset_ns - before.offset_ns) / (since_ns + until_ns) * 1e6,
    )


class PaperFilter:
    """The paper's: mean of the midpoint offsets of a synchronisation, low-passed from the second one on.

    Vaidis et al. 2021, section III-B and equation 1 with w = 0.1. It has no skew, so its offset lags behind a clock that
    drifts; its bound accounts for that.
    """

    _MAX_SKEW = MAX_SKEW / 1e9
    _WEIGHT = 0.1

    def __init__(self) -> None:
        self.name = "paper"
        self._offset_ns: int | None = None
        self._last_ns = 0
        self._sigma_ns = 0.0
        self._bound_ns = 0.0

    def update(self, samples: Sequence[ClockSample], *, may_have_restarted: bool = False) -> FilterUpdate:
        """Take the whole mean the first time, later a tenth of it; the paper ignores restarts."""
        del may_have_restarted
        first = self._offset_ns is None
        # Twice the midpoint offset, less that of the first sample: whole numbers, and small ones.
        twice_ns = [2 * s.station_ns - s.sent_ns - s.received_ns for s in samples]
        mean_ns = (twice_ns[0] + round(sum(twice - twice_ns[0] for twice in twice_ns) / len(twice_ns))) // 2
        if self._offset_ns is None:
            self._offset_ns = mean_ns
        else:
            self._offset_ns += round(self._WEIGHT * (mean_ns - self._offset_ns))
        self._last_ns = samples[-1].station_ns
        drifts_ns = [self._MAX_SKEW * (self._last_ns - s.station_ns) for s in samples]
        offsets_ns = [s.max_offset_ns - self._offset_ns for s in samples]
        above_ns = min(o + d for o, d in zip(offsets_ns, drifts_ns, strict=True))
        below_ns = max(o - s.excess_ns - d for o, s, d in zip(offsets_ns, samples, drifts_ns, strict=True))
        self._bound_ns = max(above_ns, -below_ns, 0.0) + TIMESTAMP_FLOOR_NS
        scatter_ns = math.sqrt(sum((t / 2 - mean_ns) ** 2 for t in twice_ns) / len(samples))
        self._sigma_ns = math.hypot(scatter_ns / math.sqrt(len(samples)), mean_ns - self._offset_ns)
        return FilterUpdate(rejected=0, restarted=first)

    def at(self, station_ns: int) -> ClockEstimate:
        """Return the offset of the last synchronisation, whatever the time; only the bound grows."""
        if self._offset_ns is None:
            raise LookupError("the station's clock has not been synchronised yet")
        age_ns = abs(station_ns - self._last_ns)
        return ClockEstimate(
            offset_ns=self._offset_ns,
            sigma_ns=round(math.hypot(self._sigma_ns, age_ns * UNKNOWN_SKEW_SIGMA / 1e9)),
            bound_ns=math.ceil(self._bound_ns + age_ns * self._MAX_SKEW),
            skew_ppm=0.0,
        )

    def reset(self) -> None:
        """Take the next mean whole again."""
        self._offset_ns = None


class RegressionFilter:
    """Offset and skew by weighted regression over recent synchronisations, extrapolated to each measurement.

    The forward delay is known exactly, and the station's turnaround is on the way back, so an exchange's offset is that
    of the forward way alone. The way back bounds its error.
    """

    def __init__(self) -> None:
        self.name = "regression"
        self._prior = _UNKNOWN_SKEW
        self._batches: list[Batch] = []
        self._line: RegressionLine | None = None
        self._noise_ns: float | None = None

    def update(self, samples: Sequence[ClockSample], *, may_have_restarted: bool = False) -> FilterUpdate:
        """Add a synchronisation; drop old ones when the line no longer passes through all of them.

        No line reaches over a possible restart: two small steps, one after the other, would pass for a skew.
        """
        skew = self._prior.mean if self._line is None else self._line.line.skew
        batch = select_samples(samples, skew, self._noise_ns)
        if self._line is not None and not self._line.is_consistent(batch):
            self.reset()
        restarted = self._line is None
        if may_have_restarted and self._line is not None:
            self.reset()
        skew_error = 0.0 if self._line is None else self._line.skew_error
        if self._line is not None and batch.unconfirmed_ns == 0:
            gap = gap_s([*confirmed(self._batches), batch])
            skew_error = self._line.prediction_error_ns(batch) / gap
        self._batches = [*self._batches, batch][-_MAX_BATCHES:]
        self._line, bent = fit_line(self._batches, self._prior, skew_error)
        while bent and len(self._batches) > 2:
            del self._batches[0]
            self._line, bent = fit_line(self._batches, self._prior, skew_error)
        self._noise_ns = self._line.noise_ns
        return FilterUpdate(rejected=len(samples) - len(batch.station_ns), restarted=restarted)

    def at(self, station_ns: int) -> ClockEstimate:
        """Return the offset on the line at that time."""
        if self._line is None:
            raise LookupError("the station's clock has not been synchronised yet")
        line = self._line
        # The wander is a bound; as a rule skews change by a third of it at most.
        sigma_ns = math.hypot(
            line.sigma_ns(station_ns), line.wander_ns(station_ns) / 3, TIMESTAMP_FLOOR_NS / 4
        )
        return ClockEstimate(
            offset_ns=line.at_ns(station_ns),
            sigma_ns=round(sigma_ns),
            bound_ns=math.ceil(line.min_excess_ns + line.uncertainty_ns(station_ns)),
            skew_ppm=line.line.skew / PPM,
        )

    def reset(self) -> None:
        """Forget the offset but keep the skew: the crystal is still the same.

        The prediction error of the last synchronisation may come from a step that is too small to be detected; the skew
        over that step is not the crystal's, so its sigma includes that error.
        """
        if self._line is not None:
            sigma = math.hypot(
                math.sqrt(self._line.line.skew_variance), _KEPT_SKEW_SIGMA, self._line.skew_error
            )
            known = sigma < UNKNOWN_SKEW_SIGMA
            self._prior = SkewPrior(self._line.line.skew, sigma) if known else _UNKNOWN_SKEW
        self._batches = []
        self._line = None


class TimestampCheck:
    """Detects a restarted or stepped station clock from the measurements, between synchronisations; one per station.

    A new measurement was made after that of the previous reply and before its own reply; a timestamp that contradicts
    this comes from another clock than the synchronised one. Steps within a few tenths of a second remain undetected until
    the next synchronisation, and so do longer ones backwards in the first measurement after a silence: a station that was
    silent should be synchronised before its measurements are used.
    """

    def __init__(self) -> None:
        self._previous_ns: int | None = None

    def no_new_measurement(self, requested_ns: int) -> None:
        """Note that the request of that time brought no new measurement; the next one is younger."""
        self._previous_ns = requested_ns

    def check(self, stamp_ns: int, *, requested_ns: int, received_ns: int, bound_ns: int) -> bool:
        """Return whether the timestamp of a new measurement is plausible; all times are on the master's clock, in ns.

        Parameters
        ----------
        stamp_ns
            When it was made, by the present offset.
        requested_ns, received_ns
            Start of its request, and reception of the reply.
        bound_ns
            Bound of the present offset.
        """
        earliest_ns = None if self._previous_ns is None else self._previous_ns - bound_ns - _MAX_WAIT_NS
        self._previous_ns = requested_ns
        if stamp_ns > received_ns + bound_ns + _FUTURE_TOLERANCE_NS:
            return False
        return earliest_ns is None or stamp_ns >= earliest_ns
