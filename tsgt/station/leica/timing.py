"""Timestamps of a Leica instrument's distances on the host's clock, from exchanges with the instrument's own clock.

Every exchange raises InstrumentError when the instrument does not respond.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import structlog

from tsgt.service import LogLimiter
from tsgt.station.geocom import Rpc, name_of
from tsgt.station.leica.identity import numeric_values
from tsgt.station.leica.measurement import MAX_TIME_MS, Timestamp
from tsgt.timesync import ExchangeClock, InstrumentClock

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.leica.measurement import FullMeasurement
    from tsgt.timesync import HostTime

log = structlog.get_logger()

_MIN_EXCHANGES: Final = 4
_MIN_FIRST_EXCHANGES: Final = 12
_MAX_EXCHANGES: Final = 64
_SYNCHRONISATION_NS: Final = 3_000_000_000
_SYNCHRONISED_SIGMA_NS: Final = 1_000_000
"""A synchronisation ends when times are known to this sigma, over a network when they are known well enough to be used, or
after this duration. Poses are computed with a sigma of 0.6 ms, whatever the first times are known to."""

_MAX_FAILURES: Final = 3  # a single reply without a time is not conclusive

_INTERVAL_NS: Final = 500_000_000
"""Interval of exchanges for the time alone, whose replies are the fastest; twice that where they delay distances."""

_GOOD_SIGMA_NS: Final = 400_000
_IDLE_INTERVAL_NS: Final = 150_000
_MIN_SAMPLES: Final = 40
"""Until times are known to this sigma, idle time is used for exchanges, at an interval of ``_IDLE_INTERVAL_NS`` per sample
so far. Without idle time, the first samples are taken at twice the rate."""

_EXCHANGE_NS: Final = 120_000_000
_MAX_EXCHANGE_NS: Final = 200_000_000
_RESERVE_NS: Final = 10_000_000
"""Initial estimate of an exchange's duration, its bound unless the instrument pauses, and the idle time left after it."""

_MAX_NETWORK_SIGMA_NS: Final = 10_000_000
"""Over a network, distances whose times are known less well are not used: 15 mm at 1.5 m/s."""

_MAX_WAIT_NS: Final = 3_000_000_000
"""Distances that wait longer for the first time of the instrument's clock are a problem."""

_REPEAT_WINDOW_MS: Final = 60_000  # a distance older than the last one by less than this is a repetition


class DistanceTimestamper:
    """Maps the times of one instrument's distances to the host's clock, less ``latency_ns`` to the fastest reply.

    Over a network, the delay of the fastest reply is not known: the time is bounded by the requests and the replies.
    ``over_network``: whether this instrument is behind one. ``problem``: why distances are not used; empty if they are.
    """

    def __init__(self, latency_ns: int) -> None:
        self.latency_ns = latency_ns
        self.over_network = False
        self._clock_fit: InstrumentClock | ExchangeClock = InstrumentClock()
        self.problem = ""
        self._last_ms: int | None = None
        self._before_restart_ms: int | None = (
            None  # the last distance reported before a restart of the host's clock
        )
        self._log_limiter = LogLimiter()
        self._requested_ns = self._received_ns = 0
        self._exchange_ns = _EXCHANGE_NS
        self._failed = False
        self._failed_code = 0
        self._waiting_since_ns: int | None = None  # arrival of the first distance before the clock fit

    def reset(self, *, over_network: bool) -> None:
        """Start over with another instrument."""
        self.over_network = over_network
        self.host_clock_restarted()
        self._before_restart_ms = None

    def host_clock_restarted(self) -> None:
        """Start over with the host's clock; the distance that was reported last is still not new.

        Nothing else is known of the instrument's clock: it may have been switched off and on meanwhile.
        """
        if self._last_ms is not None:
            self._before_restart_ms, self._last_ms = self._last_ms, None
        self._clock_fit = ExchangeClock() if self.over_network else InstrumentClock()
        self._waiting_since_ns = None
        self.problem = ""

    async def synchronise(self, line: GeoComConnection) -> None:
        """Exchange times until the clock fit is good, or it is clear that this takes longer."""
        fit = self._clock_fit
        min_exchanges = _MIN_EXCHANGES if fit.initialised else _MIN_FIRST_EXCHANGES
        sigma_ns = _MAX_NETWORK_SIGMA_NS if self.over_network else _SYNCHRONISED_SIGMA_NS
        failures = 0
        start_ns: int | None = None
        for number in range(1, _MAX_EXCHANGES + 1):
            failures += not await self.exchange(line)
            if failures == _MAX_FAILURES:
                return
            start_ns = self._received_ns if start_ns is None else start_ns
            expired = self._received_ns - start_ns > _SYNCHRONISATION_NS
            good = fit.sigma_ns < sigma_ns or expired
            if number >= min_exchanges and fit.initialised and not fit.inconsistent and good:
                return

    async def maintain(self, line: GeoComConnection, clock: Clock, until_ns: int) -> None:
        """Exchange times regularly, and in all idle time before ``until_ns`` while that improves the fit noticeably."""
        while True:
            now_ns = clock.monotonic_ns()
            idle = until_ns - now_ns >= self._exchange_ns + _RESERVE_NS
            interval_ns = _INTERVAL_NS if idle else 2 * _INTERVAL_NS
            if idle and not self._failed and self._clock_fit.sigma_ns > _GOOD_SIGMA_NS:
                interval_ns = min(interval_ns, _IDLE_INTERVAL_NS * self._clock_fit.samples)
            elif not self._failed and self._clock_fit.samples < _MIN_SAMPLES:
                interval_ns = _INTERVAL_NS if self._clock_fit.initialised else 0
            if now_ns - self._requested_ns < interval_ns:
                return
            self._requested_ns = now_ns
            self._failed = not await self.exchange(line)
            took_ns = min(clock.monotonic_ns() - now_ns, _MAX_EXCHANGE_NS)
            self._exchange_ns = max(took_ns, self._exchange_ns - (self._exchange_ns - took_ns) // 64)
            if not idle:
                return

    async def exchange(self, line: GeoComConnection) -> bool:
        """Query the time of an angle measurement; return whether there was one: not while the instrument is tilted."""
        reply = await line.call(Rpc.TMC_GET_ANGLE1, 1)
        self._received_ns = reply.first_byte_ns
        values = numeric_values(reply, 4)
        if values is None or not 0 < abs(values[3]) <= MAX_TIME_MS:
            self._failed_code = reply.code
            return False
        resets = self._clock_fit.resets
        fit, time_ms = self._clock_fit, int(values[3])
        if isinstance(fit, ExchangeClock):
            fit.add(time_ms, reply.sent_ns, max(reply.first_byte_ns - self.latency_ns, reply.sent_ns))
        else:
            fit.add(time_ms, reply.first_byte_ns, reply.first_byte_ns - reply.sent_ns)
        self._report_reset(resets)
        return True

    def is_new(self, time_ms: int) -> bool:
        """Whether a distance with this time has not been reported before."""
        if self._last_ms is None:
            return time_ms != self._before_restart_ms
        return not 0 <= self._last_ms - time_ms < _REPEAT_WINDOW_MS

    def mark_reported(self, time_ms: int) -> None:
        """Mark the distance with this time as reported."""
        self._last_ms = time_ms

    def timestamp(self, measured: FullMeasurement) -> Timestamp | None:
        """Return the time of a distance on the host's clock; None where it is unknown or rejected."""
        if measured.time_ms is None:
            return None
        resets = self._clock_fit.resets
        time = self._clock_fit.timestamp(measured.time_ms, measured.first_byte_ns)
        self._report_reset(resets)
        if not self._clock_fit.initialised:
            self._wait_for_clock(measured.first_byte_ns)
        elif self._waiting_since_ns is not None:
            self._waiting_since_ns, self.problem = None, ""
        if time is not None and self.over_network:
            return self._over_network_timestamp(time)
        if time is None:
            now_ns = measured.first_byte_ns
            if self._clock_fit.initialised and self._log_limiter.allows("distance_time_rejected", now_ns):
                log.warning("distance_time_rejected", instrument_ms=measured.time_ms)
            return None
        return Timestamp(max(time.host_ns - self.latency_ns, 0), time.sigma_ns)

    def _wait_for_clock(self, now_ns: int) -> None:
        if self._waiting_since_ns is None:
            self._waiting_since_ns = now_ns
        if now_ns - self._waiting_since_ns >= _MAX_WAIT_NS:
            code = name_of(self._failed_code)
            self.problem = f"its distances are not used: it does not report the time of its clock: {code}"

    def _over_network_timestamp(self, time: HostTime) -> Timestamp | None:
        """Return a time unless its uncertainty is too large."""
        before, self.problem = self.problem, ""
        if time.sigma_ns > _MAX_NETWORK_SIGMA_NS:
            self.problem = (
                f"its distances are not used: their times are known to {time.sigma_ns / 1e6:.0f} ms only, by the fastest"
                f" replies over the network, and {_MAX_NETWORK_SIGMA_NS / 1e6:.0f} ms are allowed; improve the Wi-Fi, or use"
                " a cable"
            )
            if not before:
                log.warning("distance_time_uncertain", sigma_ms=round(time.sigma_ns / 1e6, 1))
            return None
        if before:
            log.info("distance_time_certain", sigma_ms=round(time.sigma_ns / 1e6, 1))
        return Timestamp(time.host_ns, time.sigma_ns)

    def _report_reset(self, resets_before: int) -> None:
        if self._clock_fit.resets != resets_before:
            log.info("instrument_clock_reset")
            self._last_ms = None
