"""The master's measurement of the link constant: from TxDone of a sender to RxDone of its receiver.

It is the same for every packet of one modem setting, but known beforehand only to a tenth of a symbol, 0.2 ms at SF 9
and 250 kHz. Four stamps tell it: a beacon goes out and the reply comes back, and the station says how long it took in
between. Half the rest is the constant. What differs between the two ways cannot be seen.
"""

from __future__ import annotations

import math
from collections import deque
from statistics import fmean, median

_POSSIBLE_SYMBOLS = 0.2
"""The constant is within this of the nominal one: twice what chips and bandwidths that have been measured differ by."""

_SIGMAS = 5.0
_OF_MEDIAN = 1.0484
"""Sigma over the median of how much two values of a normal distribution differ."""

_USUAL_NS = 25_000.0
_USUAL_EXCHANGES = 2
"""Jitter of an exchange as it is believed to be beforehand, and how many exchanges that counts for."""
_FEW = 8
"""As long as there are fewer, jitter cannot be told and no exchange that is possible is left out."""

_SHIFTED_NS = 50_000.0
"""An exchange that is less than this off is no reason for an alarm."""

_REMEMBERED = 256
"""Some 25 minutes with one exchange in 16 replies."""

UNLIKE_CHIPS_NS = 5_000
"""By how much the two ways may differ."""


class RoundTrip:
    """The link constant between the master and one station.

    Parameters
    ----------
    nominal_ns
        As known beforehand.
    symbol_ns
        Duration of a symbol.

    Attributes
    ----------
    link_ns
        The constant; nominal until it has been measured.
    sigma_ns, bound_ns
        One sigma of it, and what it is within of the truth.
    nominal_ns
        As given.
    delay_ns
        What somebody may be adding to it at present on one of the two ways, by the last exchange; 0 when that was as
        usual.
    exchanges
        How many measurements it rests on, of the last 256.
    """

    def __init__(self, nominal_ns: int, symbol_ns: int) -> None:
        self.nominal_ns = nominal_ns
        self.delay_ns = 0
        self._possible_ns = _POSSIBLE_SYMBOLS * symbol_ns
        self._last_ns: float | None = None
        self._changes_ns: deque[float] = deque(maxlen=_REMEMBERED)
        self._good_ns: deque[float] = deque(maxlen=_REMEMBERED)
        self._state(0.0, self._possible_ns)

    @property
    def exchanges(self) -> int:
        """See the class."""
        return len(self._good_ns)

    def add(self, twice_link_ns: int) -> bool:
        """Take a measurement.

        Parameters
        ----------
        twice_link_ns
            From TxDone of the beacon to RxDone of the reply, less what the station says it took in between.

        Returns
        -------
        bool
            False: the link is not like this. A packet was held up on the way, or a stamp is wrong.
        """
        off_ns = twice_link_ns / 2 - self.nominal_ns
        if self._last_ns is not None:
            self._changes_ns.append(abs(off_ns - self._last_ns))
        self._last_ns = off_ns
        jitter_ns = self._jitter_ns()
        possible = abs(off_ns) <= self._possible_ns + _SIGMAS * jitter_ns
        usual, from_usual_ns = True, abs(off_ns)
        if self._good_ns:
            from_usual_ns = abs(off_ns - median(self._good_ns))
            allowed_ns = _SIGMAS * jitter_ns * math.sqrt(1 + 1 / self.exchanges)
            usual = from_usual_ns <= max(_SHIFTED_NS, allowed_ns)
        self.delay_ns = 0 if possible and usual else math.ceil(2 * from_usual_ns)
        if possible and (usual or self.exchanges < _FEW):
            self._good_ns.append(off_ns)
            self._measure(jitter_ns)
        return possible and usual

    def _jitter_ns(self) -> float:
        """Return one sigma of an exchange, from how much each differs from the one before, believed or not.

        If stamps are worse than usual, the limits have to be wider; if all are off alike, they have not.
        """
        count = len(self._changes_ns)
        seen_ns = _OF_MEDIAN * median(self._changes_ns) if count else 0.0
        square = (_USUAL_EXCHANGES * _USUAL_NS**2 + count * seen_ns**2) / (_USUAL_EXCHANGES + count)
        return math.sqrt(square * (1 + 4 * _FEW / max(count, _FEW)))

    def _measure(self, jitter_ns: float) -> None:
        middle_ns = median(self._good_ns)
        used_ns = [off_ns for off_ns in self._good_ns if abs(off_ns - middle_ns) <= 3 * jitter_ns]
        mean_ns = max(-self._possible_ns, min(fmean(used_ns or [middle_ns]), self._possible_ns))
        bound_ns = self._possible_ns + abs(mean_ns)
        if self.exchanges >= _FEW:
            bound_ns = min(bound_ns, _SIGMAS * jitter_ns / math.sqrt(max(len(used_ns), 1)) + UNLIKE_CHIPS_NS)
        self._state(mean_ns, bound_ns)

    def _state(self, off_ns: float, bound_ns: float) -> None:
        self.link_ns = self.nominal_ns + round(off_ns)
        self.bound_ns = math.ceil(bound_ns)
        self.sigma_ns = math.ceil(bound_ns / _SIGMAS)
