"""What a station has measured and still has to deliver, and what is known of how far that has come.

A queue outlives the masters that it is delivered to: it is cut down by what one of them acknowledges, and goes on with
the next. What holds for one master only is in :class:`Delivery`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, takewhile
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.wire import RESTART_SKIP

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from tsgt.model import Status

MOST_QUEUED = 100_000
"""Eleven hours of measurements, and some 30 MB."""

_LOW_BITS = 8

Gaps = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Queued:
    """A measurement that stands in the journal and has to be delivered.

    Attributes
    ----------
    sequence
        Its running number.
    at_ns
        When it was made, on CLOCK_MONOTONIC of the station's computer.
    boot
        Since which start of that computer its clock has run like this.
    prism
        Number of the prism.
    status
        The instrument's verdict.
    horizontal, zenith
        Angles as they go over the air.
    distance_m
        Slope distance in m; None where the instrument gave none.
    """

    sequence: int
    at_ns: int
    boot: str
    prism: int
    status: Status
    horizontal: int
    zenith: int
    distance_m: float | None


class Extent(NamedTuple):
    """Which numbers a master has to wait for.

    Attributes
    ----------
    oldest
        The lowest.
    gaps
        First and last number of each stretch after it that will never come, in their order.
    """

    oldest: int
    gaps: Gaps


class Outbox:
    """What has not been acknowledged, by number.

    Parameters
    ----------
    run_start
        Number of the first measurement that this run of the client will add.
    backlog
        What earlier runs have left, oldest first; numbers below ``run_start``.

    Attributes
    ----------
    run_start
        As given.
    left_through
        Highest number that had to leave undelivered because there were too many; -1 without any.
    """

    def __init__(self, run_start: int, backlog: Iterable[Queued] = ()) -> None:
        self.run_start = run_start
        self._queue = {queued.sequence: queued for queued in backlog}
        self._next = run_start
        self.left_through = -1

    def __len__(self) -> int:
        return len(self._queue)

    @property
    def oldest(self) -> int:
        """The lowest number that is still to be delivered, or the next to be added."""
        return next(iter(self._queue), self._next)

    def add(self, queued: Queued) -> None:
        """Append the next measurement, for which the oldest leaves if there are :data:`MOST_QUEUED`.

        Raises
        ------
        ValueError
            Its number is not higher than those before.
        """
        if queued.sequence < self._next:
            raise ValueError(f"measurement {queued.sequence} comes after {self._next - 1}")
        self._queue[queued.sequence] = queued
        self._next = queued.sequence + 1
        if len(self._queue) > MOST_QUEUED:
            self.left_through = self.oldest
            del self._queue[self.left_through]

    def oldest_first(self) -> Iterator[Queued]:
        """Go through what is queued; nothing may change meanwhile."""
        return iter(self._queue.values())

    def newest_first(self) -> Iterator[Queued]:
        """Go through what is queued; nothing may change meanwhile."""
        return reversed(self._queue.values())

    def remove(self, sequences: Iterable[int]) -> None:
        """Forget what has been delivered; numbers that are not there are passed over."""
        for sequence in sequences:
            self._queue.pop(sequence, None)

    def remove_through(self, sequence: int) -> None:
        """Forget everything up to a number, itself included."""
        self.remove(list(takewhile(lambda queued: queued <= sequence, self._queue)))

    def keep(self, wanted: Callable[[Queued], bool]) -> int:
        """Forget what is not wanted; return how many that were."""
        before = len(self._queue)
        self._queue = {sequence: queued for sequence, queued in self._queue.items() if wanted(queued)}
        return before - len(self._queue)

    def extent(self, wanted: Callable[[Queued], bool]) -> Extent:
        """Tell which numbers a master has to wait for, of those that are wanted."""
        numbers = [queued.sequence for queued in self._queue.values() if wanted(queued)]
        numbers.append(self._next)
        gaps = []
        for before, after in pairwise(numbers):
            first, last = before + 1, after - 1
            if first < self.run_start <= after:  # a master knows of what the restart has left out
                gaps += [(first, min(last, self.run_start - RESTART_SKIP - 1)), (self.run_start, last)]
            else:
                gaps.append((first, last))
        return Extent(numbers[0], tuple((first, last) for first, last in gaps if first <= last))


class Delivery:
    """How far one master has got with an outbox.

    Problem: the cumulative acknowledgement is eight bits of a number that the station has to find again. It reads the
    lowest number that has these bits and that the master is certain to have reached, so that it never takes more for
    delivered than what is. What the master is certain to have reached is everything below the oldest number in the
    outbox, unless numbers are missing that the master waits for and that never come: delivered to an earlier master,
    or lost. Then nothing beyond such a gap counts, until the gap lies behind and the station introduces itself anew,
    with a higher oldest number, below which everything is settled. It does so at once behind what a restart has left
    out, and else when all gaps lie behind.

    Parameters
    ----------
    outbox
        What is to be delivered.
    wanted
        Of its measurements those that can be delivered to this master.

    Attributes
    ----------
    oldest
        For the introduction: lowest number that is still to be delivered.
    introducing
        The master has to be told anew.
    """

    def __init__(self, outbox: Outbox, wanted: Callable[[Queued], bool]) -> None:
        self._outbox = outbox
        self._wanted = wanted
        self._acknowledged: int | None = None
        self._highest_sent = outbox.run_start - 1  # earlier runs may have sent all of these
        self.oldest, self._gaps = outbox.extent(wanted)
        self._settled = self.oldest  # as far as the master knows
        self.introducing = False
        self._reached = self.oldest - 1

    # --- Introduction -----------------------------------------------------------------------------------------

    @property
    def outdated(self) -> bool:
        """Whether the master waits for numbers that never come, and another introduction tells it so."""
        gaps = self._gaps_now()
        behind = [(first, last) for first, last in gaps if last < self._outbox.oldest]
        all_behind = bool(behind) and len(behind) == len(gaps)
        return all_behind or any(last - first >= RESTART_SKIP - 1 for first, last in behind)

    def introduce(self) -> None:
        """Set :attr:`oldest` to what is true now; the master does not know yet."""
        self.oldest, gaps = self._outbox.extent(self._wanted)
        # Until it does, it waits for what was left behind, if anything was.
        behind = ((self._settled, self.oldest - 1),) if self.oldest > self._settled else ()
        self._gaps = _union(self._gaps_now(), (*behind, *gaps))
        self.introducing = True

    def introduced(self, oldest: int) -> None:
        """Take it that the master has an introduction with this oldest number."""
        self._settled = max(self._settled, oldest)
        self.introducing = False
        self._reached = max(self._reached, oldest - 1)
        self._gaps = tuple((max(first, oldest), last) for first, last in self._gaps if last >= oldest)

    # --- Sequence numbers -------------------------------------------------------------------------------------

    def may_be_narrow(self, sequence: int, newest: int) -> bool:
        """Whether the master finds a number again from its low bits, next to the highest that it has.

        Parameters
        ----------
        sequence
            The number.
        newest
            The highest that is sent along with it.
        """
        if self._acknowledged is None:
            return False
        half = 1 << _LOW_BITS - 1
        highest = max(self._highest_sent, newest)
        return abs(sequence - self._acknowledged) < half and highest + 1 - sequence < half

    def sent(self, sequences: Iterable[int]) -> None:
        """Take it that these numbers are on the air."""
        self._highest_sent = max((self._highest_sent, *sequences))

    # --- Acknowledgement --------------------------------------------------------------------------------------

    def delivered(self, sequences: Sequence[int]) -> None:
        """Take it that the master has these numbers."""
        self._outbox.remove(sequences)
        known = () if self._acknowledged is None else (self._acknowledged,)
        self._acknowledged = max((*sequences, *known), default=None)

    def delivered_through(self, low_bits: int) -> None:
        """Take the low bits of the number up to which the master has everything."""
        certain = self._outbox.oldest - 1
        if gaps := self._gaps_now():
            certain = min(certain, gaps[0][0] - 1)
        self._reached = max(self._reached, certain)
        number = self._reached + (low_bits - self._reached) % (1 << _LOW_BITS)
        if number <= self._highest_sent:
            self._reached = number
            self._outbox.remove_through(number)

    def _gaps_now(self) -> Gaps:
        """Return the gaps, with what has left the outbox since."""
        left = self._outbox.left_through
        return self._gaps if left < self._settled else _union(self._gaps, ((self._settled, left),))


def _union(one: Gaps, other: Gaps) -> Gaps:
    joined: list[tuple[int, int]] = []
    for first, last in sorted((*one, *other)):
        if joined and first <= joined[-1][1] + 1:
            joined[-1] = (joined[-1][0], max(joined[-1][1], last))
        else:
            joined.append((first, last))
    return tuple(joined)
