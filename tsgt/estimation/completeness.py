"""Up to when a station's measurements have all arrived, though a radio that repeats what was lost mixes up their order.

Pure. A measurement that is missing is noticed by its number, and waited for until the transport limit has passed: a
pose that did not wait would lie on a straight line over the gap, and stay so.
"""

from __future__ import annotations

import heapq


class Arrivals:
    """Follows the numbers of one station's measurements.

    Numbers rise by one from measurement to measurement. Lower ones with younger times are a new count.

    Parameters
    ----------
    transport_limit_ns
        A measurement that has not arrived this long after it was made is not waited for.
    """

    def __init__(self, transport_limit_ns: int) -> None:
        self._limit_ns = transport_limit_ns
        self._next: int | None = None
        self._complete_ns = 0
        self._beyond: list[tuple[int, int]] = []  # heap of numbers and times behind a gap

    def add(self, sequence: int, time_ns: int) -> None:
        """Take note of a measurement.

        Parameters
        ----------
        sequence
            Its number.
        time_ns
            When it was made; like all instants here on the master's Unix clock in ns.
        """
        if self._next is not None and sequence > self._next:
            heapq.heappush(self._beyond, (sequence, time_ns))
            return
        if self._next is not None and sequence < self._next:
            if time_ns <= max(self._complete_ns, max((at_ns for _, at_ns in self._beyond), default=0)):
                return
            self._beyond.clear()
        self._take(sequence, time_ns)
        self._close()

    def complete_ns(self, now_ns: int) -> int:
        """Return the time of the last measurement before which none is waited for any more; 0 before the first one."""
        while self._beyond and self._beyond[0][1] < now_ns - self._limit_ns:
            self._take(*heapq.heappop(self._beyond))
            self._close()
        return self._complete_ns

    def given_up_after_ns(self, time_ns: int) -> int | None:
        """Return the time of the measurement at whose limit the gaps before a time are given up; None without any."""
        following, complete_ns, last_ns = self._next, self._complete_ns, 0
        for sequence, at_ns in sorted(self._beyond):
            if complete_ns >= time_ns:
                break
            if following is not None and sequence > following:
                last_ns = max(last_ns, at_ns)
            following, complete_ns = sequence + 1, max(complete_ns, at_ns)
        return last_ns if last_ns and complete_ns >= time_ns else None

    def _close(self) -> None:
        while self._beyond and self._next is not None and self._beyond[0][0] <= self._next:
            self._take(*heapq.heappop(self._beyond))

    def _take(self, sequence: int, time_ns: int) -> None:
        self._next = sequence + 1
        self._complete_ns = max(self._complete_ns, time_ns)
