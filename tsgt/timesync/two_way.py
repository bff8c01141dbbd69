"""What a station's clock shows against the master's, from two-way exchanges.

A clock offset is positive when the station's clock is ahead of the master's: a station's stamp less the offset is the
time on the master's clock. docs/explanation/clock-offset.md tells how both filters work and what they cannot see.

Each exchange brackets the truth. The station cannot have stamped the request before it had it, so the offset is at
most ``station_ns - (sent_ns + forward_ns)``; and it must have stamped before it answered, so the offset is at least
that less ``excess_ns``. Everything here rests on these two sentences.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

from tsgt.timesync.offset_regression import (
    LARGEST_FREQUENCY,
    PPM,
    STAMP_FLOOR_NS,
    UNKNOWN_FREQUENCY_SIGMA,
    Frequency,
    Line,
    confirmed,
    fit,
    gap_s,
    highest_offset_ns,
    sift,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ClockSample
    from tsgt.timesync.offset_regression import Batch

# A crystal outlives the step or restart of the clock that counts its beats, its temperature does not.
_KEPT_FREQUENCY_SIGMA = 3 * PPM
_UNKNOWN_FREQUENCY = Frequency(0.0, UNKNOWN_FREQUENCY_SIGMA)

# One hour of re-synchronisations every 300 s. What is older says nothing about the clock's frequency now.
_MOST_BATCHES = 12

# A measurement may lie this long in the station, between its stamp and when the radio can have it.
_WAITING_NS = 150_000_000
# Nothing is measured in the future, but its stamp may be rounded.
_ROUNDING_NS = 10_000_000


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """A station's clock against the master's at one instant.

    Attributes
    ----------
    offset_ns
        In ns, positive when the station's clock is ahead.
    sigma_ns
        One sigma of it in ns, as far as scatter and ageing tell.
    bound_ns
        The truth lies within this of ``offset_ns``, in ns, asymmetry of the two ways included.
    frequency_ppm
        By how much the station's clock gains on the master's, in 1e-6; positive when it runs fast. 0 where the
        filter does not know.
    """

    offset_ns: int
    sigma_ns: int
    bound_ns: int
    frequency_ppm: float


@dataclass(frozen=True, slots=True)
class Updated:
    """What a filter made of a synchronisation.

    Attributes
    ----------
    rejected
        How many of its exchanges were left out.
    restarted
        Everything known before was thrown away, or there was nothing.
    """

    rejected: int
    restarted: bool


class ClockFilter(Protocol):
    """Follows the clock of one station from synchronisation to synchronisation."""

    name: str

    def update(self, samples: Sequence[ClockSample], *, anew: bool = False) -> Updated:
        """Take the exchanges of one synchronisation.

        Parameters
        ----------
        samples
            At least one, in the order of time.
        anew
            The station's program may have been started again since the synchronisation before, with another clock.
        """
        ...

    def at(self, station_ns: int) -> ClockEstimate:
        """Return the offset when the station's clock shows the given time in ns.

        Raises
        ------
        LookupError
            There has been no synchronisation yet, or none since everything was forgotten.
        """
        ...

    def forget(self) -> None:
        """Throw away what is known of the offset: the station's clock has been set or started anew."""
        ...


def clock_filter(name: Literal["regression", "paper"]) -> ClockFilter:
    """Make the filter of that name, for one station."""
    return RegressionFilter() if name == "regression" else PaperFilter()


# ------------------------------------------------------------------------------------------------ the paper's


class PaperFilter:
    """The paper's: mean of the midpoint offsets of a synchronisation, low-passed from the second one on.

    Vaidis et al. 2021, section III-B and equation 1 with w = 0.1. It knows no frequency, so between and behind
    synchronisations it lags behind a clock that drifts; its bound says so.
    """

    _DRIFT = LARGEST_FREQUENCY / 1e9
    _WEIGHT = 0.1

    def __init__(self) -> None:
        self.name = "paper"
        self._offset_ns: int | None = None
        self._last_ns = 0
        self._sigma_ns = 0.0
        self._bound_ns = 0.0

    def update(self, samples: Sequence[ClockSample], *, anew: bool = False) -> Updated:
        """Take the mean whole the first time, later a tenth of it; ``anew`` is nothing that the paper knows of."""
        del anew
        first = self._offset_ns is None
        # Twice the midpoint offset, less that of the first sample: whole numbers, and small ones.
        twice_ns = [2 * s.station_ns - s.sent_ns - s.received_ns for s in samples]
        mean_ns = (twice_ns[0] + round(sum(twice - twice_ns[0] for twice in twice_ns) / len(twice_ns))) // 2
        if self._offset_ns is None:
            self._offset_ns = mean_ns
        else:
            self._offset_ns += round(self._WEIGHT * (mean_ns - self._offset_ns))
        self._last_ns = samples[-1].station_ns
        drifts_ns = [self._DRIFT * (self._last_ns - s.station_ns) for s in samples]
        offsets_ns = [highest_offset_ns(s) - self._offset_ns for s in samples]
        above_ns = min(o + d for o, d in zip(offsets_ns, drifts_ns, strict=True))
        below_ns = max(o - s.excess_ns - d for o, s, d in zip(offsets_ns, samples, drifts_ns, strict=True))
        self._bound_ns = max(above_ns, -below_ns, 0.0) + STAMP_FLOOR_NS
        scatter_ns = math.sqrt(sum((t / 2 - mean_ns) ** 2 for t in twice_ns) / len(samples))
        self._sigma_ns = math.hypot(scatter_ns / math.sqrt(len(samples)), mean_ns - self._offset_ns)
        return Updated(rejected=0, restarted=first)

    def at(self, station_ns: int) -> ClockEstimate:
        """Return the offset of the last synchronisation, whatever the time; only the bound grows."""
        if self._offset_ns is None:
            raise LookupError("the station's clock has not been synchronised yet")
        age_ns = abs(station_ns - self._last_ns)
        return ClockEstimate(
            offset_ns=self._offset_ns,
            sigma_ns=round(math.hypot(self._sigma_ns, age_ns * UNKNOWN_FREQUENCY_SIGMA / 1e9)),
            bound_ns=math.ceil(self._bound_ns + age_ns * self._DRIFT),
            frequency_ppm=0.0,
        )

    def forget(self) -> None:
        """Take the next mean whole again."""
        self._offset_ns = None


# --------------------------------------------------------------------------------------------- the regression


class RegressionFilter:
    """Offset and frequency by weighted regression over recent synchronisations, carried on to each measurement.

    The request's way out is known exactly and the station's turn-round lies on the way back, so the offset of an
    exchange is taken from the way out alone. The way back says how much it may be wrong.
    """

    def __init__(self) -> None:
        self.name = "regression"
        self._prior = _UNKNOWN_FREQUENCY
        self._batches: list[Batch] = []
        self._line: Line | None = None
        self._noise_ns: float | None = None

    def update(self, samples: Sequence[ClockSample], *, anew: bool = False) -> Updated:
        """Add a synchronisation; let go of old ones when the line no longer passes through all of them.

        No line reaches over what may have been a restart: two small steps, one after the other, would pass for a frequency.
        """
        frequency = self._prior.mean if self._line is None else self._line.frequency
        batch = sift(samples, frequency, self._noise_ns)
        if self._line is not None and not self._line.consistent_with(batch):
            self.forget()
        restarted = self._line is None
        if anew and self._line is not None:
            self.forget()
        bend = 0.0 if self._line is None else self._line.bend
        if self._line is not None and batch.doubt_ns == 0:
            bend = self._line.missed_ns(batch) / gap_s([*confirmed(self._batches), batch])
        self._batches = [*self._batches, batch][-_MOST_BATCHES:]
        self._line, bent = fit(self._batches, self._prior, bend)
        while bent and len(self._batches) > 2:
            del self._batches[0]
            self._line, bent = fit(self._batches, self._prior, bend)
        self._noise_ns = self._line.noise_ns
        return Updated(rejected=len(samples) - len(batch.station_ns), restarted=restarted)

    def at(self, station_ns: int) -> ClockEstimate:
        """Return the offset on the line at that time."""
        if self._line is None:
            raise LookupError("the station's clock has not been synchronised yet")
        line = self._line
        # The wander is a limit; frequencies change by a third of it at most, as a rule.
        sigma_ns = math.hypot(line.sigma_ns(station_ns), line.wander_ns(station_ns) / 3, STAMP_FLOOR_NS / 4)
        return ClockEstimate(
            offset_ns=line.at_ns(station_ns),
            sigma_ns=round(sigma_ns),
            bound_ns=math.ceil(line.least_excess_ns + line.uncertainty_ns(station_ns)),
            frequency_ppm=line.frequency / PPM,
        )

    def forget(self) -> None:
        """Forget the offset but remember the frequency: the crystal is still the same.

        The last synchronisation may have missed the line before because the clock had been set by less than anybody
        can tell; the frequency found over that step is no crystal's.
        """
        if self._line is not None:
            sigma = math.hypot(math.sqrt(self._line.variances[2]), _KEPT_FREQUENCY_SIGMA, self._line.bend)
            known = sigma < UNKNOWN_FREQUENCY_SIGMA
            self._prior = Frequency(self._line.frequency, sigma) if known else _UNKNOWN_FREQUENCY
        self._batches = []
        self._line = None


# -------------------------------------------------------------------------------------------------- in between


class ArrivalCheck:
    """Notices a restarted or stepped station clock from the measurements themselves, between synchronisations.

    A new measurement was made after the one of the previous answer and before its own answer; a stamp that says
    otherwise comes from a clock that is not the one that was synchronised. Steps within a few tenths of a second go
    unnoticed here until the next synchronisation, and so do longer ones backwards in the first measurement after a
    silence: a station that was silent should be synchronised before its measurements are used. One object per station.
    """

    def __init__(self) -> None:
        self._previous_ns: int | None = None

    def nothing_new(self, requested_ns: int) -> None:
        """Note that the request of that time was answered without a new measurement; the next one is younger."""
        self._previous_ns = requested_ns

    def check(self, stamp_ns: int, *, requested_ns: int, received_ns: int, bound_ns: int) -> bool:
        """Judge a measurement that the master did not have yet; all times are on the master's clock, in ns.

        Parameters
        ----------
        stamp_ns
            When it was made, by the present offset.
        requested_ns
            When the request began that it is the answer to.
        received_ns
            When the answer had been received.
        bound_ns
            Bound of the present offset.

        Returns
        -------
        bool
            True when the stamp is plausible.
        """
        earliest_ns = None if self._previous_ns is None else self._previous_ns - bound_ns - _WAITING_NS
        self._previous_ns = requested_ns
        if stamp_ns > received_ns + bound_ns + _ROUNDING_NS:
            return False
        return earliest_ns is None or stamp_ns >= earliest_ns
