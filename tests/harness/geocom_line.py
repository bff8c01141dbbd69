"""A line with a GeoCOM instrument at its end that answers what it is asked, in memory, with all that can go wrong."""

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

if TYPE_CHECKING:
    from tsgt.clock import Clock

REQUEST = re.compile(r"%R1Q,(?P<rpc>\d+),(?P<transaction>\d+)(?:,(?P<checksum>\d+))?:(?P<parameters>.*)")

ANSWER_S = 0.02
"""How long the instrument takes."""

Fault = Callable[[str], list[tuple[float, bytes]]]
"""What becomes of an answer: bytes on the line, each lot so many seconds after the request."""


def checksum_of(text: str) -> int:
    """CRC-16/ARC by long division, bit by bit: slow, and not as the program does it."""
    bits = [byte >> bit & 1 for byte in text.encode() for bit in range(8)] + [0] * 16
    generator = [1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 1]
    for start in range(len(bits) - 16):
        if bits[start]:
            for place, bit in enumerate(generator):
                bits[start + place] ^= bit
    return sum(bit << place for place, bit in enumerate(bits[-16:]))


def answered(line: str) -> list[tuple[float, bytes]]:
    """Say it."""
    return [(ANSWER_S, line.encode() + b"\r\n")]


def silent(_: str) -> list[tuple[float, bytes]]:
    """Say nothing."""
    return []


def late(seconds: float) -> Fault:
    """Take longer."""
    return lambda line: [(seconds, line.encode() + b"\r\n")]


def doubled(line: str) -> list[tuple[float, bytes]]:
    """Say it twice."""
    return [*answered(line), (ANSWER_S + 0.001, line.encode() + b"\r\n")]


def torn(place: int, pause_s: float = 0.05) -> Fault:
    """Say it in two pieces."""

    def fault(line: str) -> list[tuple[float, bytes]]:
        data = line.encode() + b"\r\n"
        return [(ANSWER_S, data[:place]), (ANSWER_S + pause_s, data[place:])]

    return lambda line: [(at_s, data) for at_s, data in fault(line) if data]


def cut(place: int) -> Fault:
    """Leave its end out."""
    return lambda line: [(ANSWER_S, line.encode()[:place])]


def damaged(line: str) -> list[tuple[float, bytes]]:
    """Get a bit wrong, where it can be seen."""
    data = bytearray(line.encode())
    data[-1] ^= 0x80
    return [(ANSWER_S, bytes(data) + b"\r\n")]


def garbage_before(garbage: bytes) -> Fault:
    """Say something else before it."""
    return lambda line: [(ANSWER_S / 2, garbage), *answered(line)]


def not_taken(com_code: int) -> Fault:
    """Carry nothing out: neither the request nor its number has been understood."""
    return lambda _: answered(f"%R1P,{com_code},0:0")


@dataclass
class FakeInstrument:
    """It answers every request with code 0 and the parameters of the request.

    Attributes
    ----------
    baud
        At another one it hears and says nothing that makes sense.
    checksums
        Whether it puts checksums on its answers.
    faults
        What becomes of the answers from now on, one after the other; then all is well.
    busy
        While it searches it answers nothing but an abortion.
    heard
        Every request, with everything that came between.
    """

    baud: int = 115_200
    checksums: bool = False
    garbles: bool = True
    faults: deque[Fault] = field(default_factory=deque)
    busy: bool = False
    heard: list[bytes] = field(default_factory=list)

    def answers(self, line: bytes) -> list[tuple[float, bytes]]:
        """Hear a line; return what comes of it."""
        self.heard.append(line)
        if line == b"c":
            self.busy = False
            return [(ANSWER_S, b"?\r\n")]
        found = REQUEST.fullmatch(line.decode("ascii"))
        if found is None or self.busy:
            return []
        answer = f"%R1P,0,{found['transaction']}:0"
        if found["parameters"]:
            answer += f",{found['parameters']}"
        if self.checksums:
            head, body = answer.split(":", 1)
            answer = f"{head},{checksum_of(answer)}:{body}"
        fault = self.faults.popleft() if self.faults else answered
        return fault(answer)

    @property
    def requests(self) -> list[bytes]:
        """What it was asked for, without what only keeps the line in step."""
        return [line for line in self.heard if line.startswith(b"%R1Q") and not line.startswith(b"%R1Q,0,")]


class MemoryPort:
    """A :class:`~tsgt.station.serial.base.Port` on the running event loop."""

    def __init__(self, instrument: FakeInstrument, baud: int, clock: Clock) -> None:
        self.name = "line"
        self.baud = baud
        self.closed = False
        self._instrument = instrument
        self._clock = clock
        self._sent = b""
        self._chunks: deque[Chunk] = deque()
        self._came = asyncio.Event()
        self._gone = False

    def write(self, data: bytes) -> None:
        """Let the instrument hear it."""
        self._check()
        if self.baud != self._instrument.baud:
            if self._instrument.garbles:
                self.come(ANSWER_S, b"\xfe\x80\r\x7f\n\xff")
            return
        self._sent += data
        while (end := min(filter(lambda at: at >= 0, map(self._sent.find, (b"\r", b"\n"))), default=-1)) >= 0:
            line, self._sent = self._sent[:end], self._sent[end + 1 :]
            if line:
                for after_s, answer in self._instrument.answers(line):
                    self.come(after_s, answer)

    def come(self, after_s: float, data: bytes) -> None:
        """Let bytes come from the line."""
        asyncio.get_running_loop().call_later(after_s, self._come, data)

    def _come(self, data: bytes) -> None:
        self._chunks.append(Chunk(data, self._clock.monotonic_ns()))
        self._came.set()

    async def read(self) -> Chunk:
        """Return the next bytes."""
        while not self._chunks:
            self._check()
            self._came.clear()
            await self._came.wait()
        return self._chunks.popleft()

    def drain(self) -> bytes:
        """Forget what has come."""
        self._check()
        data = b"".join(chunk.data for chunk in self._chunks)
        self._chunks.clear()
        return data

    def unplug(self) -> None:
        """Be gone."""
        self._gone = True
        self._came.set()

    async def close(self) -> None:
        """Be closed."""
        self.closed = True
        self.unplug()

    def _check(self) -> None:
        if self._gone:
            raise InstrumentError("line: the line is gone")


@dataclass
class Cable:
    """What opens the line to an instrument, at any number of bits per second.

    Attributes
    ----------
    ports
        Every port that has been opened.
    impossible
        Speeds that the adapter does not have.
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
