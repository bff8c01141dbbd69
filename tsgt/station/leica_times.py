"""When a Leica instrument measured, on the host's clock, and which of its distances are new."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import structlog

from tsgt.station.geocom import Rpc
from tsgt.station.instrument_clock import InstrumentClock
from tsgt.station.leica_identity import numbers
from tsgt.station.leica_measurement import MOST_MS

if TYPE_CHECKING:
    from tsgt.station.geocom_connection import GeoComConnection
    from tsgt.station.leica_measurement import FullMeasurement

log = structlog.get_logger()

_FEWEST_EXCHANGES: Final = 4
_FIRST_EXCHANGES: Final = 12
_MOST_EXCHANGES: Final = 24

_REFUSALS: Final = 3
"""One answer without a time may be an accident of the moment."""

_SOON: Final = 40
"""Until the envelope rests on so many samples, pauses are used to take some more: it is worth some ms at the start."""

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

    @property
    def stands(self) -> bool:
        """Whether times can be told; distances alone would tell them worse, for their answers come late."""
        return self._fit.stands

    @property
    def wants_more(self) -> bool:
        """Whether another exchange would make times noticeably better."""
        return self._fit.samples < _SOON

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
        fewest = _FEWEST_EXCHANGES if self._fit.stands else _FIRST_EXCHANGES
        refused = 0
        for number in range(1, _MOST_EXCHANGES + 1):
            refused += not await self.exchange(line)
            if refused == _REFUSALS:
                return
            if number >= fewest and self._fit.stands and not self._fit.doubts:
                return

    async def exchange(self, line: GeoComConnection) -> bool:
        """Ask for the time of an angle; return whether there was one. An instrument that is not level gives none."""
        reply = await line.call(Rpc.TMC_GET_ANGLE1, 1)
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

    def stamp(self, measured: FullMeasurement) -> int | None:
        """Return when a distance was taken, on the host's clock; None where that is not known or is doubted."""
        if measured.time_ms is None:
            return None
        began = self._fit.began
        time = self._fit.stamp(measured.time_ms, measured.first_byte_ns)
        self._note(began)
        if time is None:
            if self._fit.stands and self._is_worth_a_line(measured.first_byte_ns):
                log.warning("distance_time_doubted", instrument_ms=measured.time_ms)
            return None
        return max(time.host_ns - self.latency_ns, 0)

    def _note(self, began: int) -> None:
        if self._fit.began != began:
            log.info("instrument_time_began_anew")
            self._last_ms = None

    def _is_worth_a_line(self, now_ns: int) -> bool:
        if self._logged_ns is not None and now_ns - self._logged_ns < _LEAST_NOISE_NS:
            return False
        self._logged_ns = now_ns
        return True
