"""A recording while the disk does what it likes: lines that it refuses wait until it takes them."""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING

import structlog

from tsgt.errors import RecordingError

if TYPE_CHECKING:
    from tsgt.recording import RecordingWriter

WAITING_LINES = 100_000
"""About an hour of measurements and poses of three stations, 100 MB."""

HUNG_FACTOR = 2
"""A disk that refuses lines is told from one that does not even answer, for which this many times more may wait."""

log = structlog.get_logger()


class Recorder:
    """Writes lines in order; on a full or failing disk keeps them in memory and tries again with the next line.

    Where the caller must not wait for a slow disk, it calls :meth:`put`, and :meth:`flush` in a thread. A line that
    was put is written by :meth:`close` at the latest, whatever became of the thread. Lines are numbered as they are
    put, so that the caller can find out what became of them.

    Parameters
    ----------
    writer
        The open recording.
    waiting_lines
        How many lines wait at most; beyond that the oldest are lost, and counted in the log.

    Attributes
    ----------
    lost
        How many lines have been lost in all.
    """

    def __init__(self, writer: RecordingWriter, *, waiting_lines: int = WAITING_LINES) -> None:
        self._writer = writer
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._waiting_lines = waiting_lines
        self._lock = threading.Lock()
        self._failing = False
        self._lost = 0
        self._taken = 0
        self.lost = 0
        self._done = 0
        self._lost_numbers: list[range] = []

    @property
    def waiting(self) -> int:
        """How many lines are not in the file yet."""
        return len(self._waiting)

    @property
    def taken(self) -> int:
        """How many lines have been put; the number of the next one."""
        return self._taken

    def written(self, numbers: range) -> bool | None:
        """Tell whether lines are in the file; False: one is lost, None: one still waits."""
        if any(lost.start < numbers.stop and numbers.start < lost.stop for lost in self._lost_numbers):
            return False
        return True if numbers.stop <= self._done else None

    @property
    def failing(self) -> bool:
        """Whether the disk refused a line the last time that it was tried."""
        return self._failing

    def put(self, line: bytes) -> None:
        """Take a line without writing it yet; never waits."""
        number, self._taken = self._taken, self._taken + 1
        if len(self._waiting) < HUNG_FACTOR * self._waiting_lines:
            self._waiting.append((number, line))
        else:  # a write has been hanging for hours, and the oldest lines are in its hands
            self._lose(number)

    def flush(self) -> None:
        """Write what waits, in order; never raises because of the disk. May be called from another thread."""
        with self._lock:
            self._write_waiting()

    def write_line(self, line: bytes) -> None:
        """Append a line, and before it those that still wait; never raises because of the disk."""
        self.put(line)
        self.flush()

    def close(self) -> None:
        """Try once more to write what waits, and say how many lines are lost if that fails."""
        self.flush()
        if self._waiting:
            log.error("recording_incomplete", lost_lines=self._lost + len(self._waiting))
            self._waiting.clear()

    def _write_waiting(self) -> None:
        try:
            while self._waiting:
                number, line = self._waiting[0]
                self._writer.write_line(line)
                self._waiting.popleft()
                self._done = number + 1
        except RecordingError as error:
            if not self._failing:
                log.error("recording_failed", error=str(error))  # noqa: TRY400 (the message says it all)
            self._failing = True
            while len(self._waiting) > self._waiting_lines:
                self._lose(self._waiting.popleft()[0])
        else:
            if self._failing:
                log.info("recording_recovered", lost_lines=self._lost)
            self._failing, self._lost = False, 0

    def _lose(self, number: int) -> None:
        if not self._lost:
            log.error("recording_loses_lines", waiting=len(self._waiting))
        self._lost += 1
        self.lost += 1
        follows = self._lost_numbers and self._lost_numbers[-1].stop == number
        first = self._lost_numbers.pop().start if follows else number
        self._lost_numbers.append(range(first, number + 1))
