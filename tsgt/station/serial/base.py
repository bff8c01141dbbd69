"""The interface of an instrument driver to its line: a serial port or a TCP connection, real or simulated."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple, Protocol


class Chunk(NamedTuple):
    """Data received at once, at least one byte; ``at_ns`` (CLOCK_MONOTONIC) is not before the end of the last byte."""

    data: bytes
    at_ns: int


class Port(Protocol):
    """An open port with one owner; methods raise InstrumentError once the line is lost: close it then, and reopen."""

    @property
    def name(self) -> str:
        """Name for messages."""

    @property
    def baud(self) -> int | None:
        """Bits per second, where a byte takes ten bits; None for a network, whose delays are unknown."""

    def write(self, data: bytes) -> None:
        """Queue data for sending; does not wait."""

    async def read(self) -> Chunk:
        """Return the next data; may be cancelled without loss."""

    def drain(self) -> bytes:
        """Return and discard unread data; does not wait."""

    async def close(self) -> None:
        """Close the port; unsent data is lost."""


OpenPort = Callable[[int], Coroutine[Any, Any, Port]]
"""Opens the port at a baud rate, which a network ignores; raises InstrumentError."""
