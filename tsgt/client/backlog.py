"""Sans-I/O: holds records back until it is known how old they are.

The offset of the clocks comes from lines that were read as soon as they arrived. A program that was busy reads many lines at
once: the first one would make an offset by which it is new itself, the next one a smaller offset, by which it is new, and so
on. So poses and measurements wait until what has piled up is read; then the newest line dates them all. An empty socket
alone does not tell that, for the master sends the rest of its queue as the reader makes room.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

from tsgt.client.records import Hello, Measurement, Pose, Record

if TYPE_CHECKING:
    from tsgt.client.decoder import Decoder, MasterClock

PROMPT_NS = 100_000_000
"""What is read this soon after the socket was empty has arrived just now."""

STEADY_NS = 50_000_000
"""A backlog is read when the offset has stayed the same for this long: its lines lower it by seconds in that time."""

STEADY_OFFSET_NS = 50_000_000  # its changes that do not count: lines of poses are 50 ms apart

UNKNOWN_NS = 2_000_000_000
"""How long poses wait for a line that tells the offset; the master's status comes each second."""

MAX_PAUSE_NS = 250_000_000_000
"""Two clocks may drift apart by 50 ms in this time; after a longer pause in reading, the offset has to be found again."""

MAX_HELD = 4000
"""Records; the oldest ones of more are old by those behind them. More than a queue of the master has."""

MAX_TAKEN = 1000  # at once, so that no queue of an iterator overflows


class Backlog:
    """Takes the records of a decoder, and gives them, in the same order, when their age is known."""

    def __init__(self, decoder: Decoder, now_ns: int) -> None:
        self._decoder = decoder
        self._held: deque[tuple[Record, MasterClock]] = deque()
        self._caught_up = False
        self._empty_ns = now_ns
        self._steady: tuple[int, float] | None = None
        """Since when the offset has stayed the same, and the offset; None: it was not looked at since the backlog began."""

    @property
    def left(self) -> bool:
        """Whether :meth:`take` would give something."""
        return bool(self._held) and self._goes(self._held[0][0])

    @property
    def until_ns(self) -> int | None:
        """When to look at the socket again in any case, to find that the backlog is read; None: never."""
        if self._caught_up or self._steady is None:
            return None
        return self._steady[0] + (UNKNOWN_NS if math.isinf(self._steady[1]) else STEADY_NS)

    def connected(self, now_ns: int) -> None:
        """Begin a connection."""
        self._empty_ns = now_ns

    def received(self, now_ns: int) -> None:
        """Tell that something has been read."""
        if now_ns - self._empty_ns > MAX_PAUSE_NS:
            self._caught_up, self._steady = False, None

    def put(self, record: Record) -> None:
        """Add a record."""
        if isinstance(record, Hello):
            self._caught_up, self._steady = False, None
        self._held.append((record, self._decoder.clock))

    def emptied(self, now_ns: int) -> None:
        """Tell that all that had arrived has been read."""
        prompt = now_ns - self._empty_ns <= PROMPT_NS
        self._empty_ns = now_ns
        offset_ns = self._decoder.offset_ns
        if self._caught_up or (math.isinf(offset_ns) and all(_ageless(record) for record, _ in self._held)):
            return
        if self._steady is None or offset_ns < self._steady[1] - STEADY_OFFSET_NS:
            self._caught_up = prompt and self._steady is None and math.isfinite(offset_ns)
            self._steady = (now_ns, offset_ns)
        elif self.until_ns is not None and now_ns >= self.until_ns:
            self._caught_up = True

    def ended(self) -> None:
        """Tell that the connection is lost: nothing more will tell the age of what is held."""
        self._caught_up = True

    def clear(self) -> None:
        """Drop what is held."""
        self._held.clear()

    def take(self) -> list[Record]:
        """Return the next records, :data:`MAX_TAKEN` at most."""
        taken: list[Record] = []
        while self.left and len(taken) < MAX_TAKEN:
            record, clock = self._held.popleft()
            if isinstance(record, Pose | Measurement) and clock.known:
                epoch_ns = clock.here_ns(record.stamp_ns)
                if epoch_ns != record.epoch_ns:  # a copy takes as long as a third of the decoding
                    record = replace(record, epoch_ns=epoch_ns)
            taken.append(record)
        return taken

    def _goes(self, record: Record) -> bool:
        return self._caught_up or len(self._held) > MAX_HELD or _ageless(record)


def _ageless(record: Record) -> bool:
    return not isinstance(record, Pose | Measurement)
