"""What comes on the line, cut into the replies of a GeoCOM instrument, each with its arrival."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from tsgt.station.serial import Chunk

_REPLY_MARK: Final = b"%R1P"
_MAX_LINE: Final = 4096  # far more than the longest reply; more than that without an end is no line
_NS_PER_BYTE_AT_1_BAUD: Final = 10_000_000_000  # start bit, eight bits, stop bit


class StampedLine(NamedTuple):
    """A line and its arrival.

    Attributes
    ----------
    data
        From ``%R1P`` to its end, which is left out.
    first_byte_ns
        When its first byte had come, on CLOCK_MONOTONIC, in ns.
    """

    data: bytes
    first_byte_ns: int


class ReplyLines:
    """Cuts what comes on the line into replies, whatever else comes with them.

    A reply begins at ``%R1P`` and ends at CR or LF. What stands before it is dropped, and so is the beginning of a reply in
    the middle of which another one begins.

    Parameters
    ----------
    baud
        Bits per second of the line, from which the arrival of a byte inside a chunk follows.
    """

    __slots__ = ("_arrivals", "_buffer", "_byte_ns")

    def __init__(self, baud: int) -> None:
        self._byte_ns = _NS_PER_BYTE_AT_1_BAUD / baud
        self._buffer = b""
        self._arrivals: list[tuple[int, int]] = []  # where a chunk ends in the buffer, and when that was

    def push(self, chunk: Chunk) -> list[StampedLine]:
        """Take what came; return the replies that are complete now."""
        self._buffer += chunk.data
        self._arrivals.append((len(self._buffer), chunk.at_ns))
        *ended, rest = self._buffer.replace(b"\n", b"\r").split(b"\r")
        lines = []
        start = 0
        for line in ended:
            mark = line.rfind(_REPLY_MARK)
            if mark >= 0:
                lines.append(StampedLine(line[mark:], self._arrival_ns(start + mark)))
            start += len(line) + 1
        self._keep(rest if len(rest) <= _MAX_LINE else b"")
        return lines

    def clear(self) -> None:
        """Forget what has come of an incomplete line."""
        self._keep(b"")

    def _keep(self, rest: bytes) -> None:
        dropped = len(self._buffer) - len(rest)
        self._buffer = rest
        self._arrivals = [(end - dropped, at_ns) for end, at_ns in self._arrivals if end > dropped]

    def _arrival_ns(self, index: int) -> int:
        end, at_ns = next((end, at_ns) for end, at_ns in self._arrivals if end > index)
        return at_ns - round((end - index) * self._byte_ns)
