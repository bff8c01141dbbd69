"""The instrument's own time on the host's clock, from exchanges with it.

A response carries a time in ms since the instrument was switched on, and arrives after a delay that varies above a minimum.
So "arrival less instrument time" lies above a line, the lower envelope: its height is the clock offset plus the minimum
delay, its slope the skew. Where the duration of each exchange explains its delay, the line is that of exchanges as fast as
the fastest one. docs/explanation/instrument-time.md states errors and what is unobservable.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.timesync.delay_envelope import RESOLUTION_NS, DelayEnvelope, capped, few_samples, lowest_delay
from tsgt.timesync.duration_regression import DurationRegression

if TYPE_CHECKING:
    from collections.abc import Sequence

MIN_SAMPLES = 8

MAX_DELAY_NS = 2_000_000_000
"""A response further above the envelope than this is not late: a clock has jumped."""

_STEADY_NS = 120e9  # a skew from a longer span than this is kept over a power cycle

_UNKNOWN_SKEW_SIGMA = 60e-6
_KNOWN_SKEW_SIGMA = 5e-6
"""Sigma of the skew before and after it was measured."""

_REFIT_GROWTH = 1.05  # refit without other news when the number of samples has grown by this factor

_FASTER_TOLERANCE_NS = 5e6
"""A sample below the others is one of a faster response, and no corrupted one, if its exchange took less than theirs by as much,
within this."""

_CANDIDATES = 3
_CANDIDATE_SPREAD_NS = 100e6
_CANDIDATE_WINDOW = 32
"""This many inconsistent samples within this spread, in a window of this many samples, replace the envelope."""


class HostTime(NamedTuple):
    """An instant on the host's CLOCK_MONOTONIC, plus the minimum delay, on whose constancy the bound depends."""

    host_ns: int
    sigma_ns: int
    bound_ns: int


@dataclass(frozen=True, slots=True)
class _Sample:
    """The time of a response."""

    instrument_ms: int
    arrived_ns: int
    took_ns: int | None  # from the request to the arrival; None: unknown

    @property
    def offset_ns(self) -> int:
        """Arrival less instrument time."""
        return self.arrived_ns - self.instrument_ms * 1_000_000


class _Durations:
    """How long exchanges take, in ns: at least ``fastest``. An instrument that is switched off and on is as fast as before."""

    def __init__(self, first: Sequence[int]) -> None:
        """Expect durations as these."""
        self.fastest = min(first)
        self._mean_excess = median(first) - self.fastest
        self._count = 0
        self._sum = 0.0

    def add(self, took_ns: int) -> None:
        """Take the duration of an exchange."""
        self.fastest = min(self.fastest, took_ns)
        self._count += 1
        self._sum += self.fastest + capped(took_ns - self.fastest, self._mean_excess)
        self._mean_excess = self._sum / self._count - self.fastest

    @property
    def minimum(self) -> tuple[float, float]:
        """The shortest possible duration and its sigma."""
        lowest = lowest_delay(self._mean_excess, self._count, whole_ms=False)
        return self.fastest - lowest.mean, few_samples(self._count) * lowest.sigma

    @property
    def excess(self) -> float:
        """How far the fastest one is above it, as a multiple of which the bound is stated."""
        return 2 * self._mean_excess / self._count


class InstrumentClock:
    """Fits the clock of one instrument.

    A sample far from the envelope is inconsistent: it is used only when others agree with it. If these are too far off
    for any delay, the instrument was switched off and on or its count has jumped, and the fit is reset. ``resets``: how
    often the instrument's count has restarted. ``inconsistent``: whether the last sample, or distance, is inconsistent
    with the envelope.
    """

    def __init__(self) -> None:
        self._whole_ms = True
        self._known_skew = 0.0  # host against instrument; survives a power cycle
        self._known_sigma = _UNKNOWN_SKEW_SIGMA
        self._durations: _Durations | None = None  # survives it too
        self._seen = 0
        self.resets = 0
        self.inconsistent = False
        self._reset([])

    def _reset(self, samples: list[_Sample]) -> None:
        self._initial = samples
        self._responses = DelayEnvelope(self._known_skew, [0.0])
        self._regression = DurationRegression()
        self._x0 = self._y0 = 0
        self._newest = 0.0
        self._fitted = 0
        self._candidates: deque[tuple[int, _Sample]] = deque(maxlen=_CANDIDATES)

    @property
    def initialised(self) -> bool:
        """Whether there were enough samples for times."""
        return self._fitted > 0

    @property
    def samples(self) -> int:
        """How many samples the envelope rests on."""
        return self._responses.samples

    @property
    def sigma_ns(self) -> float:
        """One sigma of the newest times; infinite before initialisation."""
        return self._sigma_at(self._newest) if self.initialised else math.inf

    def use_fractional_milliseconds(self) -> None:
        """Take times as finer than whole ms; the caller subtracts the fraction from each arrival and adds it to each result."""
        if self._whole_ms:
            self._whole_ms = False
            if self.initialised:
                self._fit()

    def add(self, instrument_ms: int, arrived_ns: int, took_ns: int | None = None) -> bool:
        """Take an instrument time and its first byte's arrival. Returns False if the count jumped; that resets the fit.

        ``took_ns``: from the request to the arrival; None: unknown.
        """
        self._seen += 1
        self.inconsistent = False
        sample = _Sample(instrument_ms, arrived_ns, took_ns)
        if not self.initialised:
            self._initial.append(sample)
            if len(self._initial) >= MIN_SAMPLES:
                self._initialise()
            return True
        x, y = self._coordinates(instrument_ms, arrived_ns)
        if not -self._gate(x) - self._faster_by(took_ns) <= y - self._lowest_at(x) <= MAX_DELAY_NS:
            return self._add_inconsistent(sample)
        if self._put(sample) or self.samples > _REFIT_GROWTH * self._fitted:
            self._fit()
        return True

    def at(self, instrument_ms: int) -> HostTime | None:
        """Return an instrument time on the host's clock; None before initialisation."""
        if not self.initialised:
            return None
        x = float(instrument_ms * 1_000_000 - self._x0)
        # A time in whole ms is truncated: the distance was taken half of one later on average. The mean offset of the
        # regression contains that half, the height of the envelope does not. Rounding instead gives the same times.
        if self._regression.explains and self._durations is not None:
            offset = self._regression.at(x, self._durations.minimum[0])
        else:
            offset = self._responses.at(x) + (0.5 * RESOLUTION_NS if self._whole_ms else 0.0)
        host_ns = self._x0 + self._y0 + round(x + offset)
        bound = RESOLUTION_NS + 8 * self._excess + 3 * self._drift(x)
        return HostTime(host_ns, round(self._sigma_at(x)), round(bound))

    def timestamp(self, instrument_ms: int, arrived_ns: int) -> HostTime | None:
        """Return the time of a distance, from its instrument time and the arrival of the first byte of its response.

        A distance is no sample unless it is inconsistent with the envelope: its delay depends on when it was requested.
        Returns None before initialisation, or for an inconsistent distance.
        """
        if self.initialised:
            x, y = self._coordinates(instrument_ms, arrived_ns)
            self.inconsistent = False
            if not 0 <= y - self._lowest_at(x) <= MAX_DELAY_NS:
                self.add(instrument_ms, arrived_ns)
        else:
            self.add(instrument_ms, arrived_ns)
        time = self.at(instrument_ms)
        if self.inconsistent or time is None or not arrived_ns <= time.host_ns + MAX_DELAY_NS:
            return None
        return time._replace(host_ns=min(time.host_ns, arrived_ns))

    # --- Samples ----------------------------------------------------------------------------------------------

    def _coordinates(self, instrument_ms: int, arrived_ns: int) -> tuple[float, float]:
        """Return instrument time, and arrival less instrument time, from the origin of this fit."""
        x = instrument_ms * 1_000_000 - self._x0
        return float(x), float(arrived_ns - self._y0 - self._x0 - x)

    def _initialise(self) -> None:
        """Fit the first samples, without outliers among them: a corrupted one, or a jump in between."""
        middle = median([each.offset_ns for each in self._initial])
        kept = [each for each in self._initial if abs(each.offset_ns - middle) <= MAX_DELAY_NS]
        kept.sort(key=lambda each: each.offset_ns)
        if len(kept) > 2 and _is_corrupted(kept[0], kept[1], middle):
            del kept[0]
        if len(kept) < MIN_SAMPLES - 1:
            # Drop the oldest, whichever it is: most samples may be from before a power cycle.
            del self._initial[0]
            return
        kept.sort(key=lambda each: each.instrument_ms)
        self._x0 = kept[0].instrument_ms * 1_000_000
        self._y0 = kept[0].arrived_ns - self._x0
        offsets = [self._coordinates(each.instrument_ms, each.arrived_ns)[1] for each in kept]
        self._responses = DelayEnvelope(self._known_skew, offsets)
        durations = [each.took_ns for each in kept if each.took_ns is not None]
        if durations and self._durations is None:
            self._durations = _Durations(durations)
        for each in kept:
            self._put(each)
        self._initial = []
        self._fit()

    def _gate(self, x: float) -> float:
        """Return how far below the envelope a sample may lie and still be a faster response, in ns."""
        return RESOLUTION_NS + 10 * self._excess + 3 * self._drift(x)

    def _faster_by(self, took_ns: int | None) -> float:
        """Return by how much an exchange was faster than all before, in ns; 0 where unknown."""
        if took_ns is None or self._durations is None:
            return 0.0
        return max(self._durations.fastest - took_ns, 0.0)

    def _put(self, sample: _Sample) -> bool:
        """Take a sample; return whether it asks for a new fit."""
        x, y = self._coordinates(sample.instrument_ms, sample.arrived_ns)
        self._newest = max(self._newest, x)
        if sample.took_ns is not None and self._durations is not None:
            self._durations.add(sample.took_ns)
            self._regression.put(x, y, float(sample.took_ns))
        return self._responses.put(x, y)

    def _add_inconsistent(self, sample: _Sample) -> bool:
        """Hold a sample until enough others agree with it; return False if they reset the fit."""
        self.inconsistent = True
        self._candidates.append((self._seen, sample))
        agreeing = [each for _, each in self._candidates]
        offsets = [each.offset_ns for each in agreeing]
        recent = self._candidates[-1][0] - self._candidates[0][0] <= _CANDIDATE_WINDOW
        if len(offsets) < _CANDIDATES or not recent or max(offsets) - min(offsets) > _CANDIDATE_SPREAD_NS:
            return True
        points = [self._coordinates(each.instrument_ms, each.arrived_ns) for each in agreeing]
        self.inconsistent = False
        if all(abs(y - self._lowest_at(x)) <= MAX_DELAY_NS / 2 for x, y in points):
            # The minimum delay or the skew has changed: the old envelope is void, the origin stays.
            self._candidates.clear()
            self._responses.clear()
            self._regression.clear()
            for each in agreeing:
                self._put(each)
            self._fit()
            return True
        self._reset(agreeing)
        self.resets += 1
        return False

    # --- The fit ----------------------------------------------------------------------------------------------

    @property
    def _excess(self) -> float:
        """How far the lowest sample lies above the line, as a multiple of which bounds are stated, in ns."""
        if self._regression.explains and self._durations is not None:
            return self._durations.excess + self._regression.scatter / math.sqrt(self.samples)
        return self._responses.excess

    def _drift(self, x: float) -> float:
        """Return one sigma of the line by the skew alone, in ns."""
        return self._regression.drift(x) if self._regression.explains else self._responses.drift(x)

    def _lowest_at(self, x: float) -> float:
        """Return the least arrival less instrument time of exchanges as fast as the fastest one so far."""
        if self._regression.explains and self._durations is not None:
            return self._regression.at(x, self._durations.fastest) - RESOLUTION_NS
        return self._responses.lowest_at(x)

    def _sigma_at(self, x: float) -> float:
        """Return one sigma of times on the host's clock, in ns."""
        if self._regression.explains and self._durations is not None:
            return self._regression.sigma_at(x, *self._durations.minimum)
        return self._responses.sigma_at(x)

    def _fit(self) -> None:
        """Fit the line to all samples."""
        known = (self._known_skew, self._known_sigma)
        self._responses.fit(known, whole_ms=self._whole_ms)
        self._regression.fit(known)
        steady = self._regression if self._regression.explains else self._responses
        if steady.span_ns > _STEADY_NS:
            self._known_skew, self._known_sigma = steady.skew, _KNOWN_SKEW_SIGMA
        self._fitted = self.samples


def _is_corrupted(lowest: _Sample, second: _Sample, middle_ns: float) -> bool:
    """Whether the lowest sample of the first ones is too far below the second one for a response that was only faster."""
    below_ns = second.offset_ns - lowest.offset_ns
    if below_ns <= max(_FASTER_TOLERANCE_NS, 4 * (middle_ns - second.offset_ns)):
        return False
    if lowest.took_ns is None or second.took_ns is None:
        return True
    return second.took_ns - lowest.took_ns < below_ns - _FASTER_TOLERANCE_NS
