"""The lines that a supervised program prints: splitting its output, and what of it may be shown. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.service.log_limiter import LogLimiter

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock

MAX_TEXT = 200  # longer texts are truncated

LOGGED_LINE_BYTES = 120


def printable(text: str) -> str:
    """Return text from outside as one truncated line without control characters."""
    return "".join(sign if sign.isprintable() else " " for sign in text[:MAX_TEXT]).strip()


class LineSplitter:
    """Splits output into lines, truncated to ``limit_bytes``; a truncated line is invalid JSON and rejected as such."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._partial = b""

    def push(self, data: bytes) -> list[bytes]:
        """Add data; return the lines completed by it, without line ends and empty lines."""
        first, *others = data.split(b"\n")
        lines = [self._partial + first[: self._limit_bytes - len(self._partial)]]
        lines += [line[: self._limit_bytes] for line in others]
        self._partial = lines.pop()
        return [line for line in lines if line.strip()]


class RejectedLines:
    """Counts rejected lines, and logs them once a minute at most.

    ``log_rejected`` takes the reason, the start of the line, and the number of lines rejected so far. ``last``: what was
    wrong with the last one; the owner clears it with the next line that is used.
    """

    def __init__(self, clock: Clock, log_rejected: Callable[[str, str, int], None]) -> None:
        self._clock = clock
        self._log_rejected = log_rejected
        self._count = 0
        self._log_limiter = LogLimiter()
        self.last = ""

    def add(self, reason: str, line: bytes) -> None:
        """Count a line."""
        self._count += 1
        self.last = f"a line of the program was rejected: {printable(reason)}"
        if self._log_limiter.allows("rejected", self._clock.monotonic_ns()):
            shown = printable(line[:LOGGED_LINE_BYTES].decode(errors="replace"))
            self._log_rejected(printable(reason), shown, self._count)
