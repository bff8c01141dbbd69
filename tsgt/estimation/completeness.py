"""Tracks up to when a station's measurements have all arrived, although retransmissions change their order. Sans-I/O.

A missing sequence number is waited for until the transport limit: a pose computed without it would permanently lie on a
straight line over the gap.
"""

from __future__ import annotations

import heapq


class CompletenessTracker:
    """Tracks the sequence numbers of one station, which rise by one. Lower numbers with later times are a restart.

    ``transport_limit_ns``: a measurement that has not arrived this long after it was made is not waited for.
    """

    def __init__(self, transport_limit_ns: int) -> None:
        self._limit_ns = transport_limit_ns
        self._next: int | None = None
        self._complete_ns = 0
        self._after_gap: list[tuple[int, int]] = []  # heap of sequence numbers and times

    def add(self, sequence: int, time_ns: int) -> None:
        """Record a measurement and the time when it was made, on the master's Unix clock like all instants here."""
        if self._next is not None and sequence > self._next:
            heapq.heappush(self._after_gap, (sequence, time_ns))
            return
        if self._next is not None and sequence < self._next:
            if time_ns <= max(self._complete_ns, max((at_ns for _, at_ns in self._after_gap), default=0)):
                return
            self._after_gap.clear()
        self._take(sequence, time_ns)
        self._close()

    def complete_ns(self, now_ns: int) -> int:
        """Return the time of the last measurement before which none is waited for; 0 before the first one."""
        while self._after_gap and self._after_gap[0][1] < now_ns - self._limit_ns:
            self._take(*heapq.heappop(self._after_gap))
            self._close()
        return self._complete_ns

    def last_gap_end_ns(self, time_ns: int) -> int | None:
        """Return the time of the measurement at whose transport limit the gaps before a time end; None without gaps."""
        following, complete_ns, last_ns = self._next, self._complete_ns, 0
        for sequence, at_ns in sorted(self._after_gap):
            if complete_ns >= time_ns:
                break
            if following is not None and sequence > following:
                last_ns = max(last_ns, at_ns)
            following, complete_ns = sequence + 1, max(complete_ns, at_ns)
        return last_ns if last_ns and complete_ns >= time_ns else None

    def _close(self) -> None:
        while self._after_gap and self._next is not None and self._after_gap[0][0] <= self._next:
            self._take(*heapq.heappop(self._after_gap))

    def _take(self, sequence: int, time_ns: int) -> None:
        self._next = sequence + 1
        self._complete_ns = max(self._complete_ns, time_ns)
