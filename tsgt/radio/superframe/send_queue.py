"""A station's send queue, and how far one master has acknowledged it. Sans-I/O.

The queue outlives the masters that it is delivered to: each continues with what earlier ones left unacknowledged.
:class:`DeliveryProgress` holds what applies to one master only.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, takewhile
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.wire import RESTART_SKIP, quality_bound_us

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from tsgt.model import Status

QUEUE_CAPACITY = 200_000  # 22 hours at 2.5 Hz, about 60 MB; older ones stay in the journals

_MAX_QUALITY = 15
_SEQUENCE_BITS = 8

Gaps = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class QueuedMeasurement:
    """A journalled measurement that is to be delivered."""

    sequence: int
    at_ns: int  # on CLOCK_MONOTONIC of the station's computer
    boot: str  # boot id of that clock
    prism: int
    status: Status
    horizontal: int  # encoded by angle_code
    zenith: int
    distance_m: float | None  # slope distance


class StampedMeasurement(NamedTuple):
    """A queued measurement with its encoded time."""

    queued: QueuedMeasurement
    time: int  # in units of TIME_UNIT_US, not wrapped
    quality: int  # 0 to 15
    beacon_relative: bool  # the time counts from the end of the beacon; otherwise it is session time
    age_ns: int | None  # at the start of the reply; None for a measurement of an earlier boot


def quality_of(bound_us: float) -> int | None:
    """Return the best quality whose bound is not below this one; None: there is none."""
    return next((q for q in range(_MAX_QUALITY + 1) if bound_us <= quality_bound_us(q)), None)


class PendingRange(NamedTuple):
    """Sequence numbers that a master waits for."""

    oldest: int
    gaps: Gaps  # first and last number of each higher range that will never be sent, ascending


class SendQueue:
    """Measurements that are not acknowledged, by sequence number.

    ``first_sequence`` is the first number of this run of the client, and ``backlog`` what earlier runs left, oldest first.
    ``dropped_through`` is the highest number dropped because the queue was full; -1: none.
    """

    def __init__(self, first_sequence: int, backlog: Iterable[QueuedMeasurement] = ()) -> None:
        self.first_sequence = first_sequence
        self._queue = {queued.sequence: queued for queued in backlog}
        self._next = first_sequence
        self.dropped_through = -1

    def __len__(self) -> int:
        return len(self._queue)

    @property
    def oldest(self) -> int:
        """The lowest queued number, or the next to be added."""
        return next(iter(self._queue), self._next)

    def add(self, queued: QueuedMeasurement) -> None:
        """Append a measurement with the highest sequence number; drop the oldest beyond :data:`QUEUE_CAPACITY`."""
        if queued.sequence < self._next:
            raise ValueError(f"measurement {queued.sequence} comes after {self._next - 1}")
        self._queue[queued.sequence] = queued
        self._next = queued.sequence + 1
        if len(self._queue) > QUEUE_CAPACITY:
            self.dropped_through = self.oldest
            del self._queue[self.dropped_through]

    def oldest_first(self) -> Iterator[QueuedMeasurement]:
        """Iterate over the queue, which must not change meanwhile."""
        return iter(self._queue.values())

    def newest_first(self) -> Iterator[QueuedMeasurement]:
        """Iterate over the queue, which must not change meanwhile."""
        return reversed(self._queue.values())

    def remove(self, sequences: Iterable[int]) -> None:
        """Remove these numbers where they are queued."""
        for sequence in sequences:
            self._queue.pop(sequence, None)

    def remove_through(self, sequence: int) -> None:
        """Remove all numbers up to this one, inclusive."""
        self.remove(list(takewhile(lambda queued: queued <= sequence, self._queue)))

    def retain(self, deliverable: Callable[[QueuedMeasurement], bool]) -> int:
        """Remove what is not deliverable; return how many measurements that were."""
        before = len(self._queue)
        self._queue = {sequence: queued for sequence, queued in self._queue.items() if deliverable(queued)}
        return before - len(self._queue)

    def pending_range(self, deliverable: Callable[[QueuedMeasurement], bool]) -> PendingRange:
        """Return which numbers a master waits for."""
        numbers = [queued.sequence for queued in self._queue.values() if deliverable(queued)]
        numbers.append(self._next)
        gaps = []
        for before, after in pairwise(numbers):
            first, last = before + 1, after - 1
            if first < self.first_sequence <= after:  # a master knows of the numbers that the restart skipped
                gaps += [
                    (first, min(last, self.first_sequence - RESTART_SKIP - 1)),
                    (self.first_sequence, last),
                ]
            else:
                gaps.append((first, last))
        return PendingRange(numbers[0], tuple((first, last) for first, last in gaps if first <= last))


class DeliveryProgress:
    """How far one master has acknowledged a send queue.

    Problem: the cumulative acknowledgement carries the low eight bits of a sequence number, and the station must not
    delete anything that the master has not recorded. It therefore reads the lowest number with these bits that is not
    below a number that the master has certainly reached: everything below the oldest queued number. The exception are
    gaps, numbers that the master waits for and that are never sent, because an earlier master has them or they were lost.
    Nothing beyond a gap counts until a new join request, with a higher oldest number, ends the wait. The
    station sends one as soon as it has delivered everything below the numbers that a restart skipped, and otherwise when
    all gaps are below its oldest queued number.

    ``oldest`` is that of the join request, which has to be sent while ``join_pending``.
    """

    def __init__(self, send_queue: SendQueue, deliverable: Callable[[QueuedMeasurement], bool]) -> None:
        self._queue = send_queue
        self._deliverable = deliverable
        self._acknowledged: int | None = None
        self._highest_sent = send_queue.first_sequence - 1  # earlier runs may have sent all of these
        self.oldest, self._gaps = send_queue.pending_range(deliverable)
        self._known_oldest = self.oldest  # to the master
        self.join_pending = False
        self._reached = self.oldest - 1

    @property
    def outdated(self) -> bool:
        """Whether the master waits for numbers that are never sent, and needs a join request."""
        gaps = self._current_gaps()
        passed = [(first, last) for first, last in gaps if last < self._queue.oldest]
        all_passed = bool(passed) and len(passed) == len(gaps)
        return all_passed or any(last - first >= RESTART_SKIP - 1 for first, last in passed)

    def request_join(self) -> None:
        """Update :attr:`oldest` for a join request."""
        self.oldest, gaps = self._queue.pending_range(self._deliverable)
        # Until the master has the request, it also waits for what was discarded.
        discarded = ((self._known_oldest, self.oldest - 1),) if self.oldest > self._known_oldest else ()
        self._gaps = _union(self._current_gaps(), (*discarded, *gaps))
        self.join_pending = True

    def join_acknowledged(self, oldest: int) -> None:
        """Take the acknowledgement of a join request with this oldest number."""
        self._known_oldest = max(self._known_oldest, oldest)
        self.join_pending = False
        self._reached = max(self._reached, oldest - 1)
        self._gaps = tuple((max(first, oldest), last) for first, last in self._gaps if last >= oldest)

    def may_be_narrow(self, sequence: int, newest: int) -> bool:
        """Whether the master can reconstruct a number from its low bits; ``newest`` is the highest of the same reply."""
        if self._acknowledged is None:
            return False
        half = 1 << _SEQUENCE_BITS - 1
        highest = max(self._highest_sent, newest)
        return abs(sequence - self._acknowledged) < half and highest + 1 - sequence < half

    def mark_sent(self, sequences: Iterable[int]) -> None:
        """Mark numbers as sent."""
        self._highest_sent = max((self._highest_sent, *sequences))

    def acknowledge(self, sequences: Sequence[int]) -> None:
        """Remove measurements that the master has recorded."""
        self._queue.remove(sequences)
        known = () if self._acknowledged is None else (self._acknowledged,)
        self._acknowledged = max((*sequences, *known), default=None)

    def acknowledge_through(self, low_bits: int) -> None:
        """Take the cumulative acknowledgement."""
        certain = self._queue.oldest - 1
        if gaps := self._current_gaps():
            certain = min(certain, gaps[0][0] - 1)
        self._reached = max(self._reached, certain)
        number = self._reached + (low_bits - self._reached) % (1 << _SEQUENCE_BITS)
        if number <= self._highest_sent:
            self._reached = number
            self._queue.remove_through(number)

    def _current_gaps(self) -> Gaps:
        """Return the gaps, including what the full queue has dropped since."""
        dropped = self._queue.dropped_through
        if dropped < self._known_oldest:
            return self._gaps
        return _union(self._gaps, ((self._known_oldest, dropped),))


def _union(one: Gaps, other: Gaps) -> Gaps:
    joined: list[tuple[int, int]] = []
    for first, last in sorted((*one, *other)):
        if joined and first <= joined[-1][1] + 1:
            joined[-1] = (joined[-1][0], max(joined[-1][1], last))
        else:
            joined.append((first, last))
    return tuple(joined)
