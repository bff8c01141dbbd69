"""The master's receive window of one station: what has been received, recorded and acknowledged. Sans-I/O.

A station deletes what the master acknowledges, so the master acknowledges recorded measurements only. It also tracks
received measurements that are not recorded yet, to publish each one once.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING

from tsgt.radio.superframe.wire import ACK_FRAMES, RESTART_SKIP

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from tsgt.radio.superframe.wire import JoinRequest, MeasurementBlock, Reply

SEQUENCE_BITS = 8

MAX_STREAMS = 8
"""Number of remembered streams: a station that cannot write when it starts gets a new stream id for that run."""

_start = attrgetter("start")


class SequenceSet:
    """Set of sequence numbers, stored as its gaps and its highest number."""

    __slots__ = ("_gaps", "highest")

    def __init__(self) -> None:
        self.highest = -1
        self._gaps: list[range] = []

    def __contains__(self, number: int) -> bool:
        if number > self.highest:
            return False
        place = bisect_right(self._gaps, number, key=_start)
        return not (place and number in self._gaps[place - 1])

    @property
    def cumulative(self) -> int:
        """The number up to which, inclusive, the set is complete."""
        return self._gaps[0].start - 1 if self._gaps else self.highest

    @property
    def missing(self) -> int:
        """How many numbers below the highest are not in the set."""
        return sum(map(len, self._gaps))

    def add(self, numbers: range) -> None:
        """Add consecutive numbers."""
        if not numbers:
            return
        if numbers.start > self.highest + 1:
            self._add_gap(range(self.highest + 1, numbers.start))
        self.highest = max(self.highest, numbers.stop - 1)
        first = bisect_right(self._gaps, numbers.start, key=_start)
        first -= bool(first)
        last = bisect_right(self._gaps, numbers.stop - 1, key=_start)
        self._gaps[first:last] = [
            rest
            for gap in self._gaps[first:last]
            for rest in (
                range(gap.start, min(gap.stop, numbers.start)),
                range(max(gap.start, numbers.stop), gap.stop),
            )
            if rest
        ]

    def remove(self, number: int) -> None:
        """Remove a number."""
        if number in self:
            self._add_gap(range(number, number + 1))

    def _add_gap(self, gap: range) -> None:
        """Join it with its neighbours: an hour of lost measurements, removed one by one, is one gap."""
        place = bisect_right(self._gaps, gap.start, key=_start)
        before = [each for each in self._gaps[max(place - 1, 0) : place] if each.stop == gap.start]
        after = [each for each in self._gaps[place : place + 1] if each.start == gap.stop]
        joined = [*before, gap, *after]
        self._gaps[place - len(before) : place + len(after)] = [range(joined[0].start, joined[-1].stop)]

    def truncate(self, stop: int) -> None:
        """Remove all numbers from this one on."""
        self.highest = min(self.highest, stop - 1)
        self._gaps = [rest for gap in self._gaps if (rest := range(gap.start, min(gap.stop, stop)))]


@dataclass(slots=True)
class _Stream:
    """Numbers of one stream id: received, recorded, and received but not recorded.

    ``reused``: numbers of measurements of an earlier run that are not recorded yet, which the present run uses again.
    """

    received: SequenceSet = field(default_factory=SequenceSet)
    recorded: SequenceSet = field(default_factory=SequenceSet)
    pending: set[int] = field(default_factory=set)
    reused: Counter[int] = field(default_factory=Counter)
    first_sequence: int | None = None

    def begin_run(self, first_sequence: int) -> None:
        """Take the first number of another run of the client.

        As a rule it is above all others. But if the station has lost more numbers than a restart skips, it uses those from
        ``first_sequence`` on again, for other measurements. Those below are the ones that it has in its journal, and those
        that it skips. This holds if each run joins: of one in between that did not, numbers received before count as received.
        """
        self.first_sequence = first_sequence
        self.received.truncate(first_sequence)
        self.recorded.truncate(first_sequence)
        reused = {number for number in self.pending if number >= first_sequence}
        self.pending -= reused
        self.reused.update(reused)


class ReceiveWindow:
    """Received and recorded measurements of one station; ``stream_id`` is None before the first join request."""

    def __init__(self) -> None:
        self.stream_id: int | None = None
        self._current = _Stream()
        self._streams: dict[int, _Stream] = {}
        self._replies: dict[int, tuple[int, ...]] = {}

    def forget_replies(self) -> None:
        """Forget the replies of the session, not what was received in it."""
        self._replies.clear()

    @property
    def cumulative(self) -> int:
        """Number up to which, inclusive, the recording is complete; -1 at the start."""
        return self._current.recorded.cumulative

    @property
    def outstanding(self) -> int:
        """How many measurements are known to exist and have not been received."""
        return self._current.received.missing

    @property
    def unwritten(self) -> int:
        """How many measurements have been received and are not recorded yet."""
        return len(self._current.pending)

    def join(self, request: JoinRequest) -> None:
        """Take a join request: the stream may be another one, or have lost numbers at its end."""
        if request.stream_id != self.stream_id:
            self._switch_stream(request.stream_id)
        if request.first_sequence != self._current.first_sequence:
            self._current.begin_run(request.first_sequence)
        skipped = range(max(request.first_sequence - RESTART_SKIP, 0), request.first_sequence)
        for numbers in (self._current.received, self._current.recorded):
            numbers.add(range(request.oldest))
            numbers.add(skipped)
        # The station still has these, and would delete them if they counted as recorded before they are.
        for number in self._current.pending:
            if number >= request.oldest and number not in skipped:
                self._current.recorded.remove(number)

    def _switch_stream(self, stream_id: int) -> None:
        """Continue a remembered stream, or start a new one."""
        self.stream_id = stream_id
        self._current = self._streams[stream_id] = self._streams.pop(stream_id, _Stream())
        while len(self._streams) > MAX_STREAMS:
            del self._streams[next(iter(self._streams))]

    def unwrap(self, low_bits: int, request: JoinRequest | None = None) -> int:
        """Return the number with these low bits that is nearest to the highest one received or in the join request."""
        near = self._current.received.highest
        if request is not None:
            known = near if request.stream_id == self.stream_id else -1
            near = max(known, request.oldest, request.first_sequence)
        half = 1 << (SEQUENCE_BITS - 1)
        number = near + (low_bits - near + half) % (2 * half) - half
        return number if number >= 0 else number + 2 * half

    def newest_sequence(self, block: MeasurementBlock, reply: Reply) -> int:
        """Return the full number of the first measurement of a block."""
        sequence = block.measurements[0].sequence
        return sequence if block.wide else self.unwrap(sequence, reply.join_request)

    def accept(self, number: int) -> bool:
        """Mark a measurement as received; return whether it is new."""
        if number in self._current.received:
            return False
        self._current.received.add(range(number, number + 1))
        self._current.pending.add(number)
        return True

    def mark_written(self, numbers: Iterable[int]) -> None:
        """Mark measurements as recorded."""
        for number, stream in self._pending(numbers):
            stream.recorded.add(range(number, number + 1))

    def mark_lost(self, numbers: Iterable[int]) -> None:
        """Mark measurements that will not be recorded as not received: the station may send them again."""
        for number, stream in self._pending(numbers):
            if number not in stream.recorded:
                stream.received.remove(number)

    def _pending(self, numbers: Iterable[int]) -> Iterable[tuple[int, _Stream]]:
        for number in numbers:
            for stream in self._streams.values() or (self._current,):
                if number in stream.reused:  # the disk gets them in the order in which they were received
                    stream.reused -= Counter((number,))
                elif number in stream.pending:
                    stream.pending.remove(number)
                    yield number, stream

    def add_reply(self, counter: int, sequences: Sequence[int]) -> None:
        """Remember the measurements of the reply in a frame."""
        self._replies[counter] = tuple(sequences)
        for old in [old for old in self._replies if old < counter - ACK_FRAMES]:
            del self._replies[old]

    @property
    def last_reply_measurements(self) -> int:
        """Number of measurements in the last reply."""
        return len(self._replies[max(self._replies)]) if self._replies else 0

    def is_written(self, numbers: Iterable[int]) -> bool:
        """Whether all of these measurements are recorded."""
        return all(number in self._current.recorded for number in numbers)

    def ack_bitmap(self, counter: int) -> int:
        """Return which replies of the frames before this one are recorded; see ``StationEntry``."""
        bits = 0
        for bit in range(ACK_FRAMES):
            sequences = self._replies.get(counter - 1 - bit)
            if sequences is not None and self.is_written(sequences):
                bits |= 1 << bit
        return bits
