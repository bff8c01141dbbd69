"""When a Leica instrument measured, on the host's clock, and which of its distances are new.

When to ask a tracking instrument for its next distance.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

import structlog

from tsgt.station.geocom import Rpc
from tsgt.station.leica.identity import numbers
from tsgt.station.leica.measurement import MOST_MS, Stamp
from tsgt.timesync import InstrumentClock

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.leica.measurement import FullMeasurement

log = structlog.get_logger()

_FEWEST_EXCHANGES: Final = 4
_FIRST_EXCHANGES: Final = 12
_MOST_EXCHANGES: Final = 24
_MEETING_NS: Final = 1_000_000_000
_GOOD_NS: Final = 1_000_000
"""At the beginning there are some exchanges, and more until times are known this well, or this long has passed."""

_REFUSALS: Final = 3
"""One answer without a time may be an accident of the moment."""

_EVERY_NS: Final = 500_000_000
"""Between two exchanges for the time alone, whose answers are the fastest; twice that where they take others' time."""

_FINE_NS: Final = 400_000
_MORE_NS: Final = 150_000
_SOON: Final = 40
"""Until times are known this well, idle time is used for more: at first all of it, and the longer, the less, after each
exchange so long for each that there has been. Where there is none, the first few come twice as often."""

_TAKES_NS: Final = 120_000_000
_STALLS_NS: Final = 200_000_000
_SPARE_NS: Final = 10_000_000
"""How long an exchange takes before any is known, how long it takes at most unless the instrument pauses, and what is to
be left of idle time after it."""

_OLDER_MS: Final = 60_000
"""A distance that is older than the last one by less than this comes for the second time."""

_LEAST_NOISE_NS: Final = 60_000_000_000


class InstrumentTimes:
    """Puts the distances of one instrument in time.

    Parameters
    ----------
    latency_ns
        From a measurement to the fastest answer.

    Attributes
    ----------
    latency_ns
        The same.
    """

    def __init__(self, latency_ns: int) -> None:
        self.latency_ns = latency_ns
        self._fit = InstrumentClock()
        self._last_ms: int | None = None
        self._logged_ns: int | None = None
        self._asked_ns = self._answered_ns = 0
        self._takes_ns = _TAKES_NS
        self._refused = False

    @property
    def stands(self) -> bool:
        """Whether times can be told; distances alone would tell them worse, for their answers come late."""
        return self._fit.stands

    def other_instrument(self) -> None:
        """Forget everything: it is not the one that it was."""
        self._fit = InstrumentClock()
        self._last_ms = None

    async def meet(self, line: GeoComConnection) -> None:
        """Ask for times until they can be put on the host's clock, or it is clear that this takes longer.

        Raises
        ------
        InstrumentError
            It does not answer.
        """
        fit = self._fit
        met = fit.stands
        fewest = _FEWEST_EXCHANGES if met else _FIRST_EXCHANGES
        refused = 0
        begun_ns: int | None = None
        for number in range(1, _MOST_EXCHANGES + 1):
            refused += not await self.exchange(line)
            if refused == _REFUSALS:
                return
            begun_ns = self._answered_ns if begun_ns is None else begun_ns
            enough = met or fit.sigma_ns < _GOOD_NS or self._answered_ns - begun_ns > _MEETING_NS
            if number >= fewest and fit.stands and not fit.doubts and enough:
                return

    async def keep_known(self, line: GeoComConnection, clock: Clock, until_ns: int) -> None:
        """Exchange times now and then, and in all idle time for as long as that makes them noticeably better.

        Parameters
        ----------
        line, clock
            To the instrument, and of the host.
        until_ns
            Nothing else is to be asked before.

        Raises
        ------
        InstrumentError
            It does not answer.
        """
        while True:
            now_ns = clock.monotonic_ns()
            room = until_ns - now_ns >= self._takes_ns + _SPARE_NS
            every_ns = _EVERY_NS if room else 2 * _EVERY_NS
            if room and not self._refused and self._fit.sigma_ns > _FINE_NS:
                every_ns = min(every_ns, _MORE_NS * self._fit.samples)
            elif not self._refused and self._fit.samples < _SOON:
                every_ns = _EVERY_NS if self._fit.stands else 0
            if now_ns - self._asked_ns < every_ns:
                return
            self._asked_ns = now_ns
            self._refused = not await self.exchange(line)
            took_ns = min(clock.monotonic_ns() - now_ns, _STALLS_NS)
            self._takes_ns = max(took_ns, self._takes_ns - (self._takes_ns - took_ns) // 64)
            if not room:
                return

    async def exchange(self, line: GeoComConnection) -> bool:
        """Ask for the time of an angle; return whether there was one. An instrument that is not level gives none."""
        reply = await line.call(Rpc.TMC_GET_ANGLE1, 1)
        self._answered_ns = reply.first_byte_ns
        values = numbers(reply, 4)
        if values is None or not 0 < abs(values[3]) <= MOST_MS:
            return False
        began = self._fit.began
        self._fit.add(int(values[3]), reply.first_byte_ns)
        self._note(began)
        return True

    def is_new(self, time_ms: int) -> bool:
        """Tell whether a distance with this time has not been given before."""
        return self._last_ms is None or not 0 <= self._last_ms - time_ms < _OLDER_MS

    def given(self, time_ms: int) -> None:
        """Note that it has been."""
        self._last_ms = time_ms

    def stamp(self, measured: FullMeasurement) -> Stamp | None:
        """Return when a distance was taken; None where that is not known or is doubted."""
        if measured.time_ms is None:
            return None
        began = self._fit.began
        time = self._fit.stamp(measured.time_ms, measured.first_byte_ns)
        self._note(began)
        if time is None:
            if self._fit.stands and self._is_worth_a_line(measured.first_byte_ns):
                log.warning("distance_time_doubted", instrument_ms=measured.time_ms)
            return None
        return Stamp(max(time.host_ns - self.latency_ns, 0), time.sigma_ns)

    def _note(self, began: int) -> None:
        if self._fit.began != began:
            log.info("instrument_clock_reset")
            self._last_ms = None

    def _is_worth_a_line(self, now_ns: int) -> bool:
        if self._logged_ns is not None and now_ns - self._logged_ns < _LEAST_NOISE_NS:
            return False
        self._logged_ns = now_ns
        return True


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
