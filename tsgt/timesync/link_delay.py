"""The master's estimate of the link delay: from TxDone of a sender to RxDone of its receiver.

It is the same for every packet of one modem setting, but known in advance only to a tenth of a symbol, 0.2 ms at SF 9
and 250 kHz. A two-way exchange measures it: a beacon is sent, the reply is received, and the station states its
turnaround in between. Half the rest is the link delay. An asymmetry of the two ways is unobservable.
"""

from __future__ import annotations

import math
from collections import deque
from statistics import fmean, median

from tsgt.timesync.clock_line import pooled_variance

_MAX_DEVIATION_SYMBOLS = 0.2
"""The link delay is within this of the nominal one: twice the spread of the chips and bandwidths measured so far."""

_SIGMAS = 5.0
_SIGMA_OF_MEDIAN = 1.0484
"""Sigma over the median of the absolute difference of two normally distributed values."""

_PRIOR_JITTER_NS = 25_000.0  # prior of an exchange's jitter
_PRIOR_EXCHANGES = 2  # how many exchanges it counts as
_MIN_EXCHANGES = 8  # with fewer exchanges the jitter is unknown, and no possible exchange is rejected

_ANOMALY_NS = 50_000.0  # smallest deviation that is reported as an anomaly

_HISTORY_CAPACITY = 256  # 55 minutes with one exchange in 32 replies

_ASYMMETRY_NS = 5_000  # bound of the delay asymmetry between two chips


class LinkDelayEstimator:
    """Estimates the link delay between the master and one station.

    Attributes
    ----------
    link_delay_ns
        Nominal until it is measured.
    sigma_ns, bound_ns
        One sigma, and the bound of its error.
    anomaly_ns
        Extra delay of the last exchange, possibly all on one of the two ways; 0 if that was consistent.
    """

    def __init__(self, nominal_ns: int, symbol_ns: int) -> None:
        self.nominal_ns = nominal_ns
        self.anomaly_ns = 0
        self._max_deviation_ns = _MAX_DEVIATION_SYMBOLS * symbol_ns
        self._last_ns: float | None = None
        self._differences_ns: deque[float] = deque(maxlen=_HISTORY_CAPACITY)
        self._accepted_ns: deque[float] = deque(maxlen=_HISTORY_CAPACITY)
        self._set(0.0, self._max_deviation_ns)

    @property
    def exchanges(self) -> int:
        """How many of the last 256 the estimate rests on."""
        return len(self._accepted_ns)

    def add(self, round_trip_ns: int) -> bool:
        """Take an exchange.

        ``round_trip_ns``: from TxDone of the beacon to RxDone of the reply, less the turnaround that the station
        states. Returns False if rejected: a packet was delayed, or a timestamp is wrong.
        """
        deviation_ns = round_trip_ns / 2 - self.nominal_ns
        if self._last_ns is not None:
            self._differences_ns.append(abs(deviation_ns - self._last_ns))
        self._last_ns = deviation_ns
        jitter_ns = self._jitter_ns()
        possible = abs(deviation_ns) <= self._max_deviation_ns + _SIGMAS * jitter_ns
        consistent, residual_ns = True, abs(deviation_ns)
        if self._accepted_ns:
            residual_ns = abs(deviation_ns - median(self._accepted_ns))
            gate_ns = _SIGMAS * jitter_ns * math.sqrt(1 + 1 / self.exchanges)
            consistent = residual_ns <= max(_ANOMALY_NS, gate_ns)
        self.anomaly_ns = 0 if possible and consistent else math.ceil(2 * residual_ns)
        if possible and (consistent or self.exchanges < _MIN_EXCHANGES):
            self._accepted_ns.append(deviation_ns)
            self._estimate(jitter_ns)
        return possible and consistent

    def _jitter_ns(self) -> float:
        """Return one sigma of an exchange, from the differences of successive ones, rejected ones included."""
        count = len(self._differences_ns)
        sigma_ns = _SIGMA_OF_MEDIAN * median(self._differences_ns) if count else 0.0
        square = pooled_variance(
            count * sigma_ns**2, count, prior_sigma=_PRIOR_JITTER_NS, prior_weight=_PRIOR_EXCHANGES
        )
        return math.sqrt(square * (1 + 4 * _MIN_EXCHANGES / max(count, _MIN_EXCHANGES)))

    def _estimate(self, jitter_ns: float) -> None:
        """Take the mean of the accepted exchanges, without those beyond three sigma from the median."""
        median_ns = median(self._accepted_ns)
        used_ns = [each_ns for each_ns in self._accepted_ns if abs(each_ns - median_ns) <= 3 * jitter_ns]
        mean_ns = max(-self._max_deviation_ns, min(fmean(used_ns or [median_ns]), self._max_deviation_ns))
        bound_ns = self._max_deviation_ns + abs(mean_ns)
        if self.exchanges >= _MIN_EXCHANGES:
            bound_ns = min(bound_ns, _SIGMAS * jitter_ns / math.sqrt(max(len(used_ns), 1)) + _ASYMMETRY_NS)
        self._set(mean_ns, bound_ns)

    def _set(self, deviation_ns: float, bound_ns: float) -> None:
        self.link_delay_ns = self.nominal_ns + round(deviation_ns)
        self.bound_ns = math.ceil(bound_ns)
        self.sigma_ns = math.ceil(bound_ns / _SIGMAS)
