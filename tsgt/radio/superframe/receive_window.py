"""Which of a station's measurements the master has, and which of them are safe in its recording. Pure.

A station deletes what the master acknowledges, so the master acknowledges what is written and nothing else. What it
has received but not yet written is known too: it must not be handed on twice.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING

from tsgt.radio.superframe.wire import RESTART_SKIP

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.radio.superframe.wire import Introduction

NARROW_BITS = 8

KNOWN_LINEAGES = 8
"""So many are remembered: a station whose disk took nothing when it started has one of its own until it starts again."""

_start = attrgetter("start")


class Numbers:
    """A set of sequence numbers that is complete but for some gaps, however long they are.

    Parameters
    ----------
    first
        All numbers below it count as in the set.

    Attributes
    ----------
    highest
        The highest number in the set.
    """

    __slots__ = ("_gaps", "highest")

    def __init__(self, first: int) -> None:
        self.highest = first - 1
        self._gaps: list[range] = []

    def __contains__(self, number: int) -> bool:
        if number > self.highest:
            return False
        place = bisect_right(self._gaps, number, key=_start)
        return not (place and number in self._gaps[place - 1])

    @property
    def cumulative(self) -> int:
        """The number up to which, itself included, none is missing."""
        return self._gaps[0].start - 1 if self._gaps else self.highest

    @property
    def missing(self) -> int:
        """How many numbers below the highest are missing."""
        return sum(map(len, self._gaps))

    def add(self, numbers: range) -> None:
        """Put numbers that follow each other into the set."""
        if not numbers:
            return
        if numbers.start > self.highest + 1:
            self._gaps.append(range(self.highest + 1, numbers.start))
        self.highest = max(self.highest, numbers.stop - 1)
        first = bisect_right(self._gaps, numbers.start, key=_start)
        first -= bool(first)
        last = bisect_right(self._gaps, numbers.stop - 1, key=_start)
        rests = [
            rest
            for gap in self._gaps[first:last]
            for rest in (
                range(gap.start, min(gap.stop, numbers.start)),
                range(max(gap.start, numbers.stop), gap.stop),
            )
            if rest
        ]
        self._gaps[first:last] = rests

    def remove(self, number: int) -> None:
        """Take a number out again."""
        if number in self:
            self._gaps.insert(bisect_right(self._gaps, number, key=_start), range(number, number + 1))


@dataclass(slots=True)
class _Lineage:
    """What has come of one lineage of numbers: received, in the recording, and on the way there."""

    received: Numbers
    written: Numbers
    waiting: set[int] = field(default_factory=set)


class Inbox:
    """What has come from one station.

    Attributes
    ----------
    lineage
        See :class:`~tsgt.radio.superframe.wire.messages.Introduction`; None before the first one.
    """

    def __init__(self) -> None:
        self.lineage: int | None = None
        self._run_start = 0
        self._present = _Lineage(Numbers(0), Numbers(0))
        self._known: dict[int, _Lineage] = {}

    @property
    def cumulative(self) -> int:
        """Up to this number, itself included, nothing is missing in the recording; -1 at the beginning."""
        return self._present.written.cumulative

    @property
    def missing(self) -> int:
        """How many measurements are known to have been made and have not come."""
        return self._present.received.missing

    @property
    def unwritten(self) -> int:
        """How many have come and are not written yet."""
        return len(self._present.waiting)

    def introduced(self, introduction: Introduction) -> None:
        """Take what a station says of its numbers after a start, its own or the master's."""
        if introduction.lineage != self.lineage:
            self._turn_to(introduction)
        elif (
            introduction.run_start != self._run_start
            and introduction.run_start <= self._present.received.highest
        ):
            # A station that lost more than its last numbers gives some of them again.
            self._begin(introduction)
        self._run_start = introduction.run_start
        never_given = range(max(introduction.run_start - RESTART_SKIP, 0), introduction.run_start)
        for numbers in (self._present.received, self._present.written):
            numbers.add(range(introduction.oldest))
            numbers.add(never_given)
        # What the station has no more need not wait for the disk; all else must, lest the station deletes it.
        for number in self._present.waiting:
            if number >= introduction.oldest and number not in never_given:
                self._present.written.remove(number)

    def _turn_to(self, introduction: Introduction) -> None:
        """Go on with a lineage that is another one than before, but may be one of before that."""
        self.lineage = introduction.lineage
        known = self._known.pop(introduction.lineage, None)
        if known is None or introduction.run_start <= known.received.highest:
            self._begin(introduction)
        else:
            self._present = self._known[introduction.lineage] = known
        while len(self._known) > KNOWN_LINEAGES:
            del self._known[next(iter(self._known))]

    def _begin(self, introduction: Introduction) -> None:
        self._present = _Lineage(Numbers(introduction.oldest), Numbers(introduction.oldest))
        self._known[introduction.lineage] = self._present

    def unwrapped(self, low_bits: int, introduction: Introduction | None = None) -> int:
        """Return the number with these low bits that is nearest to those that have come, or were announced."""
        near = self._present.received.highest
        if introduction is not None:
            known = near if introduction.lineage == self.lineage else -1
            near = max(known, introduction.oldest, introduction.run_start)
        half = 1 << (NARROW_BITS - 1)
        number = near + (low_bits - near + half) % (2 * half) - half
        return number if number >= 0 else number + 2 * half

    def take(self, number: int) -> bool:
        """Take a measurement; return whether it is new."""
        if number in self._present.received:
            return False
        self._present.received.add(range(number, number + 1))
        self._present.waiting.add(number)
        return True

    def written(self, numbers: Iterable[int]) -> None:
        """Take note that measurements are in the recording."""
        for number in numbers:
            for lineage in self._known.values() or (self._present,):
                if number in lineage.waiting:
                    lineage.waiting.remove(number)
                    lineage.written.add(range(number, number + 1))

    def lost(self, numbers: Iterable[int]) -> None:
        """Take note that measurements will never be in the recording: they may come again, if the station has them."""
        for number in numbers:
            for lineage in self._known.values() or (self._present,):
                if number in lineage.waiting:
                    lineage.waiting.remove(number)
                    if number not in lineage.written:
                        lineage.received.remove(number)

    def is_written(self, numbers: Iterable[int]) -> bool:
        """Tell whether all of these measurements are in the recording."""
        return all(number in self._present.written for number in numbers)
