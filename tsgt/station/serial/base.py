"""The seam between what speaks to an instrument and the line that carries it: a serial port, or a simulated one."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple, Protocol


class Chunk(NamedTuple):
    """Bytes that came together.

    Attributes
    ----------
    data
        At least one byte.
    at_ns
        When this program was told of them, on CLOCK_MONOTONIC, in ns: at or after the end of the last one.
    """

    data: bytes
    at_ns: int


class Port(Protocol):
    """An open line with one owner.

    Every method raises :class:`~tsgt.errors.InstrumentError` when the line is gone, and keeps doing so; it is closed
    and opened again then.
    """

    @property
    def name(self) -> str:
        """Its name for people."""
        ...

    @property
    def baud(self) -> int:
        """Bits per second; a byte takes ten of them."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes; they are queued, nothing is waited for."""
        ...

    async def read(self) -> Chunk:
        """Return the next bytes; may be cancelled without losing any."""
        ...

    def drain(self) -> bytes:
        """Return what has come and was not read, and forget it; nothing is waited for."""
        ...

    async def close(self) -> None:
        """Close it. What is still to be sent is lost."""
        ...


OpenPort = Callable[[int], Coroutine[Any, Any, Port]]
"""Opens the line at a number of bits per second; raises InstrumentError."""
