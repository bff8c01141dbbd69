"""A GeoCOM instrument on a line in memory, with faults of the line."""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tsgt.errors import InstrumentError
from tsgt.simulation.kernel import VirtualClock
from tsgt.station.serial import Chunk
from tsgt.station.serial.chunk_queue import ChunkQueue

if TYPE_CHECKING:
    from tsgt.clock import Clock

REQUEST = re.compile(r"%R1Q,(?P<rpc>\d+),(?P<transaction>\d+)(?:,(?P<checksum>\d+))?:(?P<parameters>.*)")

REPLY_S = 0.02
"""Response time of the instrument."""

Fault = Callable[[str], list[tuple[float, bytes]]]
"""Maps a reply to pieces of data, each with its delay in s after the request."""


def checksum_of(text: str) -> int:
    """Return the CRC-16/ARC by long division, bit by bit: slow, and independent of the codec."""
    bits = [byte >> bit & 1 for byte in text.encode() for bit in range(8)] + [0] * 16
    generator = [1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 1]
    for start in range(len(bits) - 16):
        if bits[start]:
            for place, bit in enumerate(generator):
                bits[start + place] ^= bit
    return sum(bit << place for place, bit in enumerate(bits[-16:]))


def intact(line: str) -> list[tuple[float, bytes]]:
    """Send the reply."""
    return [(REPLY_S, line.encode() + b"\r\n")]


def silent(_: str) -> list[tuple[float, bytes]]:
    """Send nothing."""
    return []


def late(seconds: float) -> Fault:
    """Delay the reply."""
    return lambda line: [(seconds, line.encode() + b"\r\n")]


def doubled(line: str) -> list[tuple[float, bytes]]:
    """Send the reply twice."""
    return [*intact(line), (REPLY_S + 0.001, line.encode() + b"\r\n")]


def torn(place: int, pause_s: float = 0.05) -> Fault:
    """Send the reply in two pieces."""

    def fault(line: str) -> list[tuple[float, bytes]]:
        data = line.encode() + b"\r\n"
        return [(REPLY_S, data[:place]), (REPLY_S + pause_s, data[place:])]

    return lambda line: [(at_s, data) for at_s, data in fault(line) if data]


def cut(place: int) -> Fault:
    """Truncate the reply."""
    return lambda line: [(REPLY_S, line.encode()[:place])]


def damaged(line: str) -> list[tuple[float, bytes]]:
    """Flip a bit so that the damage is visible."""
    data = bytearray(line.encode())
    data[-1] ^= 0x80
    return [(REPLY_S, bytes(data) + b"\r\n")]


def garbage_before(garbage: bytes) -> Fault:
    """Send garbage before the reply."""
    return lambda line: [(REPLY_S / 2, garbage), *intact(line)]


def not_taken(com_code: int) -> Fault:
    """Execute nothing: the request and its transaction were not understood."""
    return lambda _: intact(f"%R1P,{com_code},0:0")


@dataclass
class FakeInstrument:
    """An instrument that replies to every request with code 0 and the request's parameters.

    Attributes
    ----------
    baud
        At another rate it exchanges garbage only.
    checksums
        Whether its replies have checksums.
    faults
        Faults of the next replies, one each.
    busy
        Whether a search is in progress, during which it responds to an abort only.
    received
        Every line.
    """

    baud: int = 115_200
    checksums: bool = False
    garbles: bool = True
    faults: deque[Fault] = field(default_factory=deque)
    busy: bool = False
    received: list[bytes] = field(default_factory=list)

    def replies(self, line: bytes) -> list[tuple[float, bytes]]:
        """Process a line; return the reply's pieces."""
        self.received.append(line)
        if line == b"c":
            self.busy = False
            return [(REPLY_S, b"?\r\n")]
        found = REQUEST.fullmatch(line.decode("ascii"))
        if found is None or self.busy:
            return []
        reply = f"%R1P,0,{found['transaction']}:0"
        if found["parameters"]:
            reply += f",{found['parameters']}"
        if self.checksums:
            head, body = reply.split(":", 1)
            reply = f"{head},{checksum_of(reply)}:{body}"
        fault = self.faults.popleft() if self.faults else intact
        return fault(reply)

    @property
    def requests(self) -> list[bytes]:
        """All requests but probes."""
        return [
            line for line in self.received if line.startswith(b"%R1Q") and not line.startswith(b"%R1Q,0,")
        ]


class MemoryPort:
    """A :class:`~tsgt.station.serial.base.Port` on the running event loop."""

    def __init__(self, instrument: FakeInstrument, baud: int, clock: Clock) -> None:
        self.name = "line"
        self.baud = baud
        self.closed = False
        self._instrument = instrument
        self._clock = clock
        self._sent = b""
        self._received = ChunkQueue()

    def write(self, data: bytes) -> None:
        """Send to the instrument."""
        self._received.check()
        if self.baud != self._instrument.baud:
            if self._instrument.garbles:
                self.come(REPLY_S, b"\xfe\x80\r\x7f\n\xff")
            return
        self._sent += data
        while (end := min(filter(lambda at: at >= 0, map(self._sent.find, (b"\r", b"\n"))), default=-1)) >= 0:
            line, self._sent = self._sent[:end], self._sent[end + 1 :]
            if line:
                for after_s, reply in self._instrument.replies(line):
                    self.come(after_s, reply)

    def come(self, after_s: float, data: bytes) -> None:
        """Let data arrive after a delay."""
        asyncio.get_running_loop().call_later(after_s, self._come, data)

    def _come(self, data: bytes) -> None:
        self._received.put(Chunk(data, self._clock.monotonic_ns()))

    async def read(self) -> Chunk:
        """Return the next bytes."""
        return await self._received.read()

    def drain(self) -> bytes:
        """Discard unread data."""
        return self._received.drain()

    def unplug(self) -> None:
        """Unplug the cable."""
        self._received.fail("line: the line is gone")

    async def close(self) -> None:
        """Close the port."""
        self.closed = True
        self.unplug()


@dataclass
class Cable:
    """Opens ports to an instrument.

    Attributes
    ----------
    ports
        All ports that were opened.
    impossible
        Baud rates that the adapter does not support.
    """

    instrument: FakeInstrument
    ports: list[MemoryPort] = field(default_factory=list)
    impossible: frozenset[int] = frozenset()
    clock: Clock = field(default_factory=lambda: VirtualClock(0))

    async def open(self, baud: int) -> MemoryPort:
        """Open it."""
        if baud in self.impossible:
            raise InstrumentError(f"line cannot be opened at {baud} baud")
        port = MemoryPort(self.instrument, baud, self.clock)
        self.ports.append(port)
        return port
