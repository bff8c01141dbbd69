"""The master's session time on a station's clock, from the beacons that it receives.

Each beacon says when the one before it left. So every beacon that is received, with one after it, makes a *pair*: when
the station received it, on its CLOCK_MONOTONIC, and the session time at which the master had sent it. The time between
the two, the link constant, is the same for all; the master adds it. docs/explanation/superframe-clock.md says how the
fit works, what its bound allows for, and what it has been seen to do.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from typing import NamedTuple

from tsgt.timesync.dual_rate import Pair, Stretch, bound_us, rate_bound_ppm

SENDER_SIGMA_NS = 20_000
COARSE_SENDER_SIGMA_NS = 1_000_000
"""The pair contains the master's stamp too, of which the station is told nothing. So at first it is taken to be as
coarse as stamps can be, until there are enough pairs to see how they scatter."""

UNKNOWN_RATE_PPM = 120.0
"""Two computers' clocks run apart by no more than this, unless pairs show it."""

DOUBTED_US = 200.0
"""A pair that is further off than this, and than is honest, cannot be what it says."""

_RATE_SIGMA_PPM = 30.0
_SLEWED_SIGMA_PPM = 200.0
"""What is known of the rate of a new clock, and of one that somebody has just touched."""

_FEWEST_RIVALS = 5
"""So many pairs in a row that agree with each other outvote the fit that they do not agree with."""

MOST_PAIRS = 10_000
_FORGOTTEN = 1_000
"""An hour and more at the usual rate; let go of in large parts."""

_UNIQUE_US = 30_000.0
"""Within half of 2^16 us the low bits of a time tell which it is; a little is left for stamps."""
_LOW_BITS_US = 65_536.0
_SURE_US = 5_000.0
"""An offset that seems to have jumped by more than this may have jumped by 2^16 us more."""

_FEWEST_IN_FULL = 2
"""A single beacon may have been held back by any time. Two in a row by the same would be worse luck than there is."""


class Instant(NamedTuple):
    """A time on the master's clock, or a duration.

    Attributes
    ----------
    time_us
        In us; session time as stations give it, without the link constant.
    sigma_us
        One standard error, as far as jitter and a usual crystal tell.
    bound_us
        The truth is within this of ``time_us``.
    """

    time_us: float
    sigma_us: float
    bound_us: float


class _Jitter:
    """How much stamps scatter, as a multiple of what they claim, from how each pair fits between its neighbours.

    What is believed beforehand counts for a few pairs, what is longer ago than some more is forgotten, and as long as
    there have been few the scatter is taken to be larger than it looks.
    """

    _ENOUGH = 8
    _FEW = 16
    _PRIOR = 1.5
    _PRIOR_PAIRS = 4.0
    _MEMORY_PAIRS = 60.0
    _LEAST = 0.1

    _MOST_AT_ONCE = 1_000.0
    """An outlier is no scatter: with sixty pairs one counts for 17 times the mean square at most. Where all of them are
    large the limit rises with each."""

    _LONGEST_NS = 15_000_000_000
    """Between neighbours that are further apart a clock may wander by as much as stamps scatter."""

    def __init__(self) -> None:
        self._pairs = self._PRIOR_PAIRS
        self._square = self._PRIOR**2
        self._seen = 0
        self._last: deque[tuple[int, int, float]] = deque(maxlen=3)

    @property
    def known(self) -> bool:
        """Whether there were enough pairs."""
        return self._seen >= self._ENOUGH

    def variance_us2(self, sigma_ns: int) -> float:
        """Return the variance of a pair whose reception claims this sigma, in us^2; never less than claimed."""
        if not self.known:
            return (sigma_ns**2 + COARSE_SENDER_SIGMA_NS**2) / 1e6
        square = self._square * (1 + self._FEW / self._seen)
        return max(square * _claimed_us2(sigma_ns), sigma_ns**2 / 1e6, 1.0)

    def add(self, pair: Pair) -> None:
        """Learn from a pair and the two before it."""
        self._last.append((pair.received_ns, pair.sent_ns - pair.received_ns, _claimed_us2(pair.sigma_ns)))
        if len(self._last) < 3:
            return
        (t0, y0, v0), (t1, y1, v1), (t2, y2, v2) = self._last
        if t2 - t0 > self._LONGEST_NS:
            return
        share = (t1 - t0) / (t2 - t0)
        missed_us = (y1 - y0 - share * (y2 - y0)) / 1000
        expected = v1 + (1 - share) ** 2 * v0 + share**2 * v2
        square = min(missed_us**2 / expected, self._MOST_AT_ONCE / self._pairs * self._square)
        self._seen += 1
        self._pairs = min(self._pairs + 1, self._MEMORY_PAIRS)
        self._square += (square - self._square) / self._pairs
        self._square = max(self._square, self._LEAST**2)


class BeaconClock:
    """Fits the master's session time to a station's clock; one for each session of the master.

    Attributes
    ----------
    first_received_ns, last_received_ns
        When the first and the newest pair were received that have been believed.
    pairs
        How many the fit rests on.
    known
        Two pairs in full have agreed, one of them live; before that there is no time.
    settled
        So many pairs agree that held-back beacons would have been outvoted.
    """

    def __init__(self) -> None:
        self._jitter = _Jitter()
        self._stretches: list[Stretch] = []
        self._begun_live = False
        self._known = False
        self._rival: Stretch | None = None
        self._rival_in_full = False  # a live one has told its times to 2^40 us, and not just to 2^16
        self._rival_live = False
        self._rival_agrees = False  # with the fit, though only because nothing was heard for long

    @property
    def first_received_ns(self) -> int | None:
        """See the class."""
        return self._stretches[0].first_ns if self._stretches else None

    @property
    def last_received_ns(self) -> int | None:
        """See the class."""
        return self._stretches[-1].last_ns if self._stretches else None

    @property
    def pairs(self) -> int:
        """See the class."""
        return sum(map(len, self._stretches))

    @property
    def known(self) -> bool:
        """See the class."""
        return self._known

    @property
    def settled(self) -> bool:
        """See the class."""
        return self._known and len(self._stretches[-1]) >= _FEWEST_RIVALS

    def add(
        self, received_ns: int, sent_us: int, sigma_ns: int, *, in_full: bool = False, live: bool = True
    ) -> bool:
        """Take a pair, in the order of reception.

        Parameters
        ----------
        received_ns
            When the beacon was received, on this computer's clock.
        sent_us
            Session time at which it had been sent.
        sigma_ns
            One sigma of ``received_ns``, as the radio states it.
        in_full
            That time is from a session part, and not from :meth:`unwrap`.
        live
            The master has heard the answer to this beacon, so that it was no recording of long ago.

        Returns
        -------
        bool
            False: this cannot be. It is more than 200 us off the fit, and more than jitter and the clocks can
            explain: a beacon that was held up, or a clock that somebody has touched. The fit keeps away from it, but
            its bound contains it until there is one that agrees. Five in a row that agree with each other instead
            begin the fit anew, if one of them was live; if they are off by more than 5 ms, a live one has to be known in
            full. Before there is a time, only pairs in full are taken, and the newer of two that do not agree
            is kept. One that jitter does not explain, but a clock that nothing was heard of for long, is kept away from
            the fit, too, until five agree with each other.
        """
        sent_ns = 1000 * sent_us
        newest_ns = self._rival.last_ns if self._rival else self.last_received_ns
        if newest_ns is not None and received_ns <= newest_ns:
            return False
        pair = Pair(received_ns, sent_ns, sigma_ns, self._jitter.variance_us2(sigma_ns))
        if not self.known:
            return in_full and self._begin(pair, live=live)
        stretch = self._stretches[-1]
        agrees, unknown = stretch.agrees(pair), not self._jitter.known
        if agrees or self._rival is not None:
            self._jitter.add(pair)  # one that stands alone tells nothing of the others
        if not agrees:
            self._doubt(pair, stretch, in_full=in_full, live=live)
            return abs(stretch.missed_us(pair)) <= DOUBTED_US
        if self._is_alone(pair, stretch, live=live):
            return True
        stretch.add(pair)
        if unknown and self._jitter.known:
            self._stretches[-1] = stretch.weighed_anew(self._jitter.variance_us2)
        self._rival = None
        self._forget()
        return True

    def unwrap(self, received_ns: int, low16: int) -> int | None:
        """Return the full session time of a beacon.

        Parameters
        ----------
        received_ns
            When it was received.
        low16
            The 16 low bits of the session time at which it had been sent, in us.

        Returns
        -------
        int | None
            In us; None where there is more than one that it can be.
        """
        if not self.known:
            return None
        rival = self._rival
        # A single beacon that was held back must not keep the next ones from being understood.
        near = _instant(rival if rival and self._rival_in_full else self._stretches[-1], received_ns)
        if near.bound_us > _UNIQUE_US:
            return None
        near_us = round(near.time_us)
        return near_us + (low16 - near_us + 0x8000) % 0x10000 - 0x8000

    def at(self, local_ns: int) -> Instant | None:
        """Return the session time at an instant of this computer's clock, between and beyond pairs; None if not known."""
        return self._at(local_ns) if self.known else None

    def elapsed(self, from_ns: int, to_ns: int) -> Instant:
        """Return how long it was by the master's clock between two instants of this computer's.

        As long as there is no time both clocks are taken to run alike, and the bound says what they can differ by.
        """
        local_us = (to_ns - from_ns) / 1000
        if not self.known:
            return _duration(local_us, 0.0, _RATE_SIGMA_PPM, UNKNOWN_RATE_PPM)
        start, end = self._at(from_ns), self._at(to_ns)
        by_ends = Instant(
            end.time_us - start.time_us,
            math.hypot(start.sigma_us, end.sigma_us),
            start.bound_us + end.bound_us,
        )
        earlier_ns, later_ns = min(from_ns, to_ns), max(from_ns, to_ns)
        index = self._index(earlier_ns)
        stretch = self._stretches[index]
        newest = index == len(self._stretches) - 1
        if later_ns > stretch.last_ns and not newest:
            return by_ends  # the rate has changed in between
        fits, _ = stretch.at((from_ns + to_ns) // 2)
        bound_ppm = rate_bound_ppm(fits)
        if self._rival is not None and newest and later_ns > stretch.last_ns:
            bound_ppm += self._doubt_us(self._rival) / ((self._rival.first_ns - stretch.last_ns) / 1e9)
        by_rate = _duration(local_us, fits.slow.rate_ppm, math.sqrt(fits.slow.rate_variance), bound_ppm)
        return by_ends if by_ends.bound_us < by_rate.bound_us else by_rate

    def _at(self, local_ns: int) -> Instant:
        index = self._index(local_ns)
        stretch = self._stretches[index]
        instant = _instant(stretch, local_ns)
        outvoted = len(stretch) < _FEWEST_RIVALS  # it may have been wrong from its first pair on
        if local_ns <= stretch.last_ns and not outvoted:
            return instant
        if index + 1 < len(self._stretches):
            # Somewhere here one stretch turned into the next; nobody knows where.
            return _either(instant, _instant(self._stretches[index + 1], local_ns))
        if self._rival is None:
            return instant
        # The rate may have changed right after the last pair.
        share = (local_ns - stretch.last_ns) / (self._rival.first_ns - stretch.last_ns)
        share = max(share, 1.0) if outvoted else share
        return instant._replace(bound_us=instant.bound_us + self._doubt_us(self._rival) * share)

    def _index(self, local_ns: int) -> int:
        """Return which stretch an instant is in; those between two belong to the earlier one."""
        return max(bisect_right(self._stretches, local_ns, key=lambda stretch: stretch.first_ns) - 1, 0)

    def _begin(self, pair: Pair, *, live: bool) -> bool:
        """Take a pair in full before there is a time; return whether it agrees with those before it."""
        alone = not self._stretches
        agrees = not alone and self._stretches[0].agrees(pair)
        if agrees:
            self._stretches[0].add(pair)
        else:
            self._jitter = _Jitter()
            self._stretches, self._begun_live = [Stretch(pair, 0.0, _RATE_SIGMA_PPM)], False
        self._jitter.add(pair)
        self._begun_live = self._begun_live or live
        self._known = self._begun_live and len(self._stretches[0]) >= _FEWEST_IN_FULL
        return agrees or alone

    def _doubt(self, pair: Pair, stretch: Stretch, *, in_full: bool, live: bool) -> None:
        """Hold a pair that does not agree with the fit against others of its kind."""
        if self._rival is None or not self._rival.agrees(pair):
            self._rival, self._rival_agrees = Stretch(pair, stretch.rate_ppm, _SLEWED_SIGMA_PPM), False
            self._rival_in_full, self._rival_live = in_full and live, live
            return
        self._rival.add(pair)
        self._rival_in_full = self._rival_in_full or (in_full and live)
        self._rival_live = self._rival_live or live
        if self._is_sure(self._rival) and self._rival_live and len(self._rival) >= _FEWEST_RIVALS:
            self._stretches.append(self._rival)
            self._rival = None

    def _is_alone(self, pair: Pair, stretch: Stretch, *, live: bool) -> bool:
        """Whether a pair that agrees with the fit has to wait for others, as it may have been held back.

        After an outage a clock may be off by more than that, and a single pair would be all that tells. One that agrees with
        those that wait only because nothing was heard for long again does not count together with them: they may have been
        held back. But it tells of the rate.
        """
        waiting = self._rival if self._rival_agrees else None
        if waiting is not None and _is_near(waiting, pair):
            if len(waiting) + 1 >= _FEWEST_RIVALS:
                stretch.add_all(waiting)
                return False
            waiting.add(pair)
            return True
        if _is_near(stretch, pair):
            return False
        rate_ppm = stretch.rate_ppm
        if waiting is not None and waiting.agrees(pair):
            waiting.add(pair)
            rate_ppm = waiting.rate_ppm
        self._rival, self._rival_agrees = Stretch(pair, rate_ppm, _SLEWED_SIGMA_PPM), True
        self._rival_in_full, self._rival_live = True, live  # it agrees, so its low bits tell which it is
        return True

    def _off_us(self, rival: Stretch) -> float:
        """Return how far the first pair of a rival is off the fit."""
        stretch = self._stretches[-1]
        fits, _ = stretch.at(rival.first_ns)
        return (rival.base_ns - stretch.base_ns) / 1000 - fits.slow.offset_us

    def _is_sure(self, rival: Stretch) -> bool:
        """Whether it is known which multiple of 2^16 us its times contain."""
        return self._rival_in_full or abs(self._off_us(rival)) <= _SURE_US

    def _doubt_us(self, rival: Stretch) -> float:
        """Return how far the fit is off if a rival is right."""
        return abs(self._off_us(rival)) + (0.0 if self._is_sure(rival) else _LOW_BITS_US)

    def _forget(self) -> None:
        """Let go of the oldest pairs when there are too many."""
        if self.pairs <= MOST_PAIRS:
            return
        oldest = self._stretches[0]
        if len(oldest) > _FORGOTTEN:
            oldest.forget(_FORGOTTEN)
        else:
            del self._stretches[0]


def _is_near(stretch: Stretch, pair: Pair) -> bool:
    """Whether jitter explains a pair, or it is off by no more than is honest."""
    return stretch.agrees_closely(pair) or abs(stretch.missed_us(pair)) <= DOUBTED_US


def _instant(stretch: Stretch, local_ns: int) -> Instant:
    fits, near_s = stretch.at(local_ns)
    return Instant(
        (local_ns + stretch.base_ns) / 1000 + fits.slow.offset_us,
        math.sqrt(fits.slow.offset_variance),
        bound_us(fits, near_s),
    )


def _either(one: Instant, other: Instant) -> Instant:
    """Return the middle of two, and a bound that contains both."""
    apart_us = abs(one.time_us - other.time_us)
    return Instant(
        (one.time_us + other.time_us) / 2,
        max(one.sigma_us, other.sigma_us) + apart_us / 2,
        max(one.bound_us, other.bound_us) + apart_us,
    )


def _duration(local_us: float, rate_ppm: float, sigma_ppm: float, bound_ppm: float) -> Instant:
    scale = abs(local_us) / 1e6
    return Instant(local_us + local_us * rate_ppm / 1e6, scale * sigma_ppm, scale * bound_ppm)


def _claimed_us2(sigma_ns: int) -> float:
    return (sigma_ns**2 + SENDER_SIGMA_NS**2) / 1e6
