"""A station's send queue, and how far one master has acknowledged it. Sans-I/O.

The queue outlives the masters that it is delivered to: each continues with what earlier ones left unacknowledged.
:class:`DeliveryProgress` holds what applies to one master only.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.wire import RESTART_SKIP, quality_bound_us

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from tsgt.model import Status

QUEUE_CAPACITY = 200_000  # 22 hours at 2.5 Hz, about 60 MB; older ones stay in the journals

_MAX_QUALITY = 15
_SEQUENCE_BITS = 8

Gaps = tuple[tuple[int, int], ...]

Reach = Callable[[str], tuple[float, float]]
"""Returns the first and last time, on the clock of a boot, at which a measurement can be timed for a master."""

UNLIMITED_REACH = -inf, inf
NO_REACH = inf, -inf

_start = attrgetter("start")


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

    Each reply searches the queue, and would be late for its slot if a search of a long queue took longer. The numbers are
    therefore kept as runs, consecutive ones of the same boot. A run is in the order of time, so the part of it that can be
    timed for a master is found by bisection.

    ``first_sequence`` is the first number of this run of the client, and ``backlog`` what earlier runs left, below it.
    ``dropped_through`` is the highest number dropped because the queue was full; -1: none.
    """

    def __init__(self, first_sequence: int, backlog: Iterable[QueuedMeasurement] = ()) -> None:
        self.first_sequence = first_sequence
        self.dropped_through = -1
        self._queue: dict[int, QueuedMeasurement] = {}
        self._runs: list[range] = []
        self._next = 0
        for _, queued in sorted({each.sequence: each for each in backlog}.items()):
            self.add(queued)
        self._next = max(self._next, first_sequence)

    def __len__(self) -> int:
        return len(self._queue)

    @property
    def oldest(self) -> int:
        """The lowest queued number, or the next to be added."""
        return self._runs[0].start if self._runs else self._next

    def add(self, queued: QueuedMeasurement) -> None:
        """Append a measurement with the highest sequence number; drop the oldest beyond :data:`QUEUE_CAPACITY`."""
        if queued.sequence < self._next:
            raise ValueError(f"measurement {queued.sequence} comes after {self._next - 1}")
        newest = self._runs[-1] if self._runs else range(0)
        if newest.stop == queued.sequence and newest and self._queue[newest.start].boot == queued.boot:
            self._runs[-1] = range(newest.start, queued.sequence + 1)
        else:
            self._runs.append(range(queued.sequence, queued.sequence + 1))
        self._queue[queued.sequence] = queued
        self._next = queued.sequence + 1
        if len(self._queue) > QUEUE_CAPACITY:
            self.dropped_through = self.oldest
            self.remove((self.dropped_through,))

    def oldest_first(self, reach: Reach = lambda _: UNLIMITED_REACH) -> Iterator[QueuedMeasurement]:
        """Iterate over what is within reach; the queue must not change meanwhile."""
        for run in self._runs:
            yield from map(self._queue.__getitem__, self._part(run, reach))

    def newest_first(self, reach: Reach = lambda _: UNLIMITED_REACH) -> Iterator[QueuedMeasurement]:
        """Iterate over what is within reach; the queue must not change meanwhile."""
        for run in reversed(self._runs):
            yield from map(self._queue.__getitem__, reversed(self._part(run, reach)))

    def _part(self, run: range, reach: Reach) -> range:
        """Return the part of a run that is within reach."""
        first_ns, last_ns = reach(self._queue[run.start].boot)
        return run[bisect_left(run, first_ns, key=self._at_ns) : bisect_right(run, last_ns, key=self._at_ns)]

    def _at_ns(self, sequence: int) -> int:
        return self._queue[sequence].at_ns

    def remove(self, sequences: Iterable[int]) -> None:
        """Remove these numbers where they are queued."""
        for sequence in sequences:
            if self._queue.pop(sequence, None) is not None:
                place = bisect_right(self._runs, sequence, key=_start) - 1
                run = self._runs[place]
                rest = range(run.start, sequence), range(sequence + 1, run.stop)
                self._runs[place : place + 1] = filter(None, rest)

    def remove_through(self, sequence: int) -> None:
        """Remove all numbers up to this one, inclusive."""
        while self.oldest <= sequence and self._runs:
            self.remove(range(self.oldest, min(self._runs[0].stop, sequence + 1)))

    def retain(self, reach: Reach) -> int:
        """Remove what is out of reach; return how many measurements that were."""
        before = len(self._queue)
        runs = [part for run in self._runs if (part := self._part(run, reach))]
        if runs != self._runs:
            self._runs = runs
            self._queue = {sequence: self._queue[sequence] for run in runs for sequence in run}
        return before - len(self._queue)

    def pending_range(self, reach: Reach) -> PendingRange:
        """Return which numbers a master waits for."""
        runs = [part for run in self._runs if (part := self._part(run, reach))]
        runs.append(range(self._next, self._next + 1))
        gaps = []
        for before, after in pairwise(runs):
            first, last = before.stop, after.start - 1
            # A master knows of the numbers that the restart skipped.
            if first < self.first_sequence <= after.start:
                gaps += [
                    (first, min(last, self.first_sequence - RESTART_SKIP - 1)),
                    (self.first_sequence, last),
                ]
            else:
                gaps.append((first, last))
        return PendingRange(runs[0].start, tuple((first, last) for first, last in gaps if first <= last))


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

    def __init__(self, send_queue: SendQueue, reach: Reach) -> None:
        self._queue = send_queue
        self._reach = reach
        self._acknowledged: int | None = None
        self._highest_sent = send_queue.first_sequence - 1  # earlier runs may have sent all of these
        self.oldest, self._gaps = send_queue.pending_range(reach)
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
        self.oldest, gaps = self._queue.pending_range(self._reach)
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
