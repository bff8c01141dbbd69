"""Records to a disk that may fail: refused lines wait until it takes them."""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING

import structlog

from tsgt.errors import RecordingError

if TYPE_CHECKING:
    from tsgt.recording import RecordingWriter

MAX_PENDING_LINES = 100_000  # about an hour of measurements and poses of three stations; 100 MB

HUNG_DISK_FACTOR = 2
"""While a write hangs, lines can not be dropped from the front of the queue; this many times more may wait then."""

log = structlog.get_logger()


class Recorder:
    """Writes lines in order; on a full or failing disk keeps them in memory and retries with the next line.

    A caller that must not wait for a slow disk calls :meth:`put`, and :meth:`flush` in a thread. :meth:`close` writes
    every pending line. Lines are numbered as they are put, so that the caller can ask which were written.
    ``max_pending_lines``: queue capacity; beyond it the oldest lines are lost, and counted in the log. ``lost``: lines
    lost in all. ``error``: why the last write failed; None if it did not.
    """

    def __init__(self, writer: RecordingWriter, *, max_pending_lines: int = MAX_PENDING_LINES) -> None:
        self._writer = writer
        self._queue: deque[tuple[int, bytes]] = deque()
        self._max_pending_lines = max_pending_lines
        self._lock = threading.Lock()
        self.error: RecordingError | None = None
        self._lost_in_outage = 0
        self._line_count = 0
        self.lost = 0
        self._written = 0
        self._synced = 0
        self._lost_numbers: list[range] = []

    @property
    def pending(self) -> int:
        """Lines that are not in the file yet."""
        return len(self._queue)

    @property
    def line_count(self) -> int:
        """Lines put so far; the number of the next one."""
        return self._line_count

    def synced(self, number: int) -> bool | None:
        """Return whether a line is on the disk, where a power cut leaves it; False: it is lost, None: it is pending."""
        if any(number in lost for lost in self._lost_numbers):
            return False
        return True if number < self._synced else None

    @property
    def failing(self) -> bool:
        """Whether the last write failed."""
        return self.error is not None

    @property
    def written_count(self) -> int:
        """Lines that are in the file, and lost ones before them."""
        return self._written

    @property
    def size(self) -> int:
        """Length of the file in bytes."""
        return self._writer.size

    def put(self, line: bytes) -> None:
        """Queue a line without writing it; never waits."""
        number, self._line_count = self._line_count, self._line_count + 1
        if len(self._queue) < HUNG_DISK_FACTOR * self._max_pending_lines:
            self._queue.append((number, line))
        else:  # a write has been hanging for hours and owns the oldest lines
            self._lose(number)

    def flush(self) -> None:
        """Write pending lines in order; never raises because of the disk. May run in another thread."""
        with self._lock:
            self._write_pending()

    def sync(self) -> None:
        """Bring all written lines to the disk, in any thread. Raises RecordingError: those since the last sync may be lost."""
        written = self._written
        self._writer.sync()
        self._synced = max(self._synced, written)

    def write_line(self, line: bytes) -> None:
        """Append a line after the pending ones; never raises because of the disk."""
        self.put(line)
        self.flush()

    def close(self) -> None:
        """Try once more to write pending lines; log how many are lost if that fails."""
        self.flush()
        if self._queue:
            log.error("recording_incomplete", lost_lines=self._lost_in_outage + len(self._queue))
            self._queue.clear()

    def _write_pending(self) -> None:
        try:
            while self._queue:
                number, line = self._queue[0]
                self._writer.write_line(line)
                self._queue.popleft()
                self._written = number + 1
        except RecordingError as error:
            if self.error is None:
                log.error("recording_failed", error=str(error))  # noqa: TRY400 (the message suffices)
            self.error = error
            while len(self._queue) > self._max_pending_lines:
                self._lose(self._queue.popleft()[0])
        else:
            if self.error is not None:
                log.info("recording_recovered", lost_lines=self._lost_in_outage)
            self.error, self._lost_in_outage = None, 0

    def _lose(self, number: int) -> None:
        if not self._lost_in_outage:
            log.error("recording_loses_lines", waiting=len(self._queue))
        self._lost_in_outage += 1
        self.lost += 1
        follows = self._lost_numbers and self._lost_numbers[-1].stop == number
        first = self._lost_numbers.pop().start if follows else number
        self._lost_numbers.append(range(first, number + 1))
