"""Splits the data from a GeoCOM instrument into reply lines with arrival times. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from tsgt.station.serial import Chunk

_REPLY_MARK: Final = b"%R1P"
_MAX_LINE: Final = 4096  # far longer than any reply; longer data without a line end is dropped
_NS_PER_BYTE_AT_1_BAUD: Final = 10_000_000_000  # start bit, eight bits, stop bit


class StampedLine(NamedTuple):
    """A line from ``%R1P`` to its end, excluded, and the arrival of its first byte on CLOCK_MONOTONIC."""

    data: bytes
    first_byte_ns: int


class ReplyLines:
    """Extracts replies from the data of a line.

    A reply starts at ``%R1P`` and ends at CR or LF. Data before it is dropped, and so is an incomplete reply that another
    one interrupts. The arrival of a byte within a chunk follows from the baud rate; over a network, where
    there is none, all bytes of a chunk arrive together.
    """

    __slots__ = ("_arrivals", "_buffer", "_byte_ns")

    def __init__(self, baud: int | None) -> None:
        self._byte_ns = _NS_PER_BYTE_AT_1_BAUD / baud if baud is not None else 0.0
        self._buffer = b""
        self._arrivals: list[tuple[int, int]] = []  # end of each chunk in the buffer, and its arrival

    def push(self, chunk: Chunk) -> list[StampedLine]:
        """Add data; return the replies completed by it."""
        data = chunk.data
        end = data.find(b"\r")
        if (
            not self._buffer
            and end + 2 == len(data)
            and data.find(b"\n") == end + 1
            and not data.rfind(_REPLY_MARK)
        ):
            # Nearly always: one whole reply.
            return [StampedLine(data[:end], chunk.at_ns - round(len(data) * self._byte_ns))]
        self._buffer += data
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
        """Drop an incomplete line."""
        self._keep(b"")

    def _keep(self, rest: bytes) -> None:
        dropped = len(self._buffer) - len(rest)
        self._buffer = rest
        self._arrivals = [(end - dropped, at_ns) for end, at_ns in self._arrivals if end > dropped]

    def _arrival_ns(self, index: int) -> int:
        end, at_ns = next((end, at_ns) for end, at_ns in self._arrivals if end > index)
        return at_ns - round((end - index) * self._byte_ns)
