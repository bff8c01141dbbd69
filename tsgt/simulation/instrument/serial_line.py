"""A cable between a simulated total station and a program in the same process, with the pace of a real one.

Bytes take as long as at the line's speed, in both directions. The cable can be pulled, the two ends may have different
speeds, and what goes wrong on cables can be ordered (:class:`~tsgt.simulation.instrument.serial_line.LineFaults`).

What can go wrong with an answer on its way through a cable.
"""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import InstrumentError
from tsgt.station.serial import Chunk

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.simulation.instrument.total_station import SimulatedTotalStation
    from tsgt.simulation.kernel import Timeline
    from tsgt.station.serial import Port

GARBAGE = b"\x00\xff\x1a%R1\x81,7"
"""Bytes that are no answer, though they begin like one."""


class LineFault(StrEnum):
    """A fault of one answer."""

    NONE = "none"
    """It comes as it is."""
    CUT = "cut"
    """Its second half does not come."""
    GARBAGE = "garbage"
    """Bytes that nobody sent come right before it."""
    SPOILT = "spoilt"
    """Bytes in its middle are others."""
    LATE = "late"
    """It comes long after."""
    DUPLICATED = "duplicated"
    """It comes twice."""
    TORN = "torn"
    """Its second half comes a while after the first."""
    DIGIT = "digit"
    """One of its digits is another one; without a checksum nobody can see that."""
    SILENCE = "silence"
    """It does not come."""


@dataclass(slots=True)
class LineFaults:
    """The faults of a line, all of which can be changed at any time.

    Attributes
    ----------
    script
        The next answers' faults, in order; answers after that have none.
    late_s
        How much later a late answer comes.
    torn_s
        How long the second half of a torn one takes.
    deaf
        Whether nothing reaches the instrument.
    mute
        Whether nothing comes back from it.
    """

    script: deque[LineFault] = field(default_factory=deque)
    late_s: float = 4.0
    torn_s: float = 0.3
    deaf: bool = False
    mute: bool = False

    def apply(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return what comes of an answer: parts, each with the ns after which it is sent."""
        if self.mute:
            return []
        fault = self.script.popleft() if self.script else LineFault.NONE
        half = len(data) // 2
        match fault:
            case LineFault.CUT:
                return [(0, data[:half])]
            case LineFault.GARBAGE:
                return [(0, GARBAGE + data)]
            case LineFault.SPOILT:
                return [(0, data[:half] + b"\x80\xfe" + data[half + 2 :])]
            case LineFault.LATE:
                return [(round(self.late_s * 1e9), data)]
            case LineFault.DUPLICATED:
                return [(0, data), (0, data)]
            case LineFault.TORN:
                return [(0, data[:half]), (round(self.torn_s * 1e9), data[half:])]
            case LineFault.DIGIT:
                return [(0, _other_digit(data))]
            case LineFault.SILENCE:
                return []
            case LineFault.NONE:
                return [(0, data)]


def _other_digit(data: bytes) -> bytes:
    """Return an answer with another digit somewhere; where, hangs on the answer."""
    digits = [i for i in range(len(data)) if data[i : i + 1].isdigit()]
    if not digits:
        return data
    at = digits[sum(data) % len(digits)]
    return data[:at] + (b"1" if data[at : at + 1] != b"1" else b"7") + data[at + 1 :]


BITS_PER_BYTE = 10


class Wire:
    """What carries the bytes, at a line's pace.

    Parameters
    ----------
    instrument
        At the far end.
    timeline
        When bytes arrive.
    deliver
        Takes what has arrived at the near end.

    Attributes
    ----------
    host_baud
        Bits per second at the near end; another number than the instrument's makes garbage of everything.
    plugged
        Whether it is in.
    faults
        What goes wrong with the instrument's answers.
    """

    def __init__(
        self,
        instrument: SimulatedTotalStation,
        timeline: Timeline,
        deliver: Callable[[bytes], None],
    ) -> None:
        self._instrument = instrument
        self._timeline = timeline
        self._deliver = deliver
        self._sent_until_ns = 0
        self._answered_until_ns = 0
        self._garbage = np.random.default_rng(0)
        self.host_baud = instrument.baud
        self.plugged = True
        self.faults = LineFaults()
        instrument.on_send = self._answer

    def send(self, data: bytes) -> None:
        """Carry bytes from the program to the instrument."""
        arrives_ns = max(self._timeline.now_ns(), self._sent_until_ns) + line_ns(len(data), self.host_baud)
        self._sent_until_ns = arrives_ns
        if self.faults.deaf:
            return
        if self.host_baud != self._instrument.baud:
            # The far end may take a part of it for a request that makes no sense.
            self._timeline.call_at(arrives_ns, lambda: self._answer(b"%R1P,3078,0:0\r\n"))
            data = self._spoil(data)
        self._timeline.call_at(arrives_ns, lambda: self._instrument.receive(data) if self.plugged else None)

    def _answer(self, data: bytes) -> None:
        """Carry what the instrument sends."""
        now_ns = self._timeline.now_ns()
        for after_ns, part in self.faults.apply(data):
            begins_ns = max(now_ns + after_ns, self._answered_until_ns)
            arrives_ns = begins_ns + line_ns(len(part), self._instrument.baud)
            if not after_ns:
                self._answered_until_ns = arrives_ns
            self._timeline.call_at(arrives_ns, partial(self._arrive, part))

    def _arrive(self, data: bytes) -> None:
        if self.plugged:
            self._deliver(data if self.host_baud == self._instrument.baud else self._spoil(data))

    def _spoil(self, data: bytes) -> bytes:
        return self._garbage.integers(128, 256, len(data), dtype=np.uint8).tobytes()


class SimulatedLine:
    """A cable in memory; one program at a time may use it.

    Parameters
    ----------
    instrument
        At the far end.
    timeline
        The true time.
    clock
        Of the host at the near end.
    name
        For people.
    """

    def __init__(
        self, instrument: SimulatedTotalStation, timeline: Timeline, clock: Clock, *, name: str = "simulated"
    ) -> None:
        self._clock = clock
        self._name = name
        self._wire = Wire(instrument, timeline, self._deliver)
        self._port: _SimulatedPort | None = None

    @property
    def faults(self) -> LineFaults:
        """What goes wrong with the instrument's answers."""
        return self._wire.faults

    @property
    def plugged(self) -> bool:
        """Whether the cable is in; pulling it breaks the open port."""
        return self._wire.plugged

    @plugged.setter
    def plugged(self, plugged: bool) -> None:
        self._wire.plugged = plugged
        if not plugged and self._port is not None:
            self._port.break_off("was unplugged")
            self._port = None

    async def open(self, baud: int) -> Port:
        """Open the near end at a number of bits per second.

        Raises
        ------
        InstrumentError
            The cable is not in, or somebody has the port already.
        """
        if not self._wire.plugged:
            raise InstrumentError(f"{self._name}: no such device; plug the cable in")
        if self._port is not None:
            raise InstrumentError(f"{self._name} is taken; it can be opened once")
        self._wire.host_baud = baud
        self._port = _SimulatedPort(self._wire, self._name, baud, self._closed)
        return self._port

    def _closed(self, port: _SimulatedPort) -> None:
        if self._port is port:
            self._port = None

    def _deliver(self, data: bytes) -> None:
        if self._port is not None:
            self._port.take(Chunk(data, self._clock.monotonic_ns()))


class _SimulatedPort:
    """The near end of a line."""

    def __init__(self, wire: Wire, name: str, baud: int, closed: Callable[[_SimulatedPort], None]) -> None:
        self._wire = wire
        self._closed = closed
        self._chunks: deque[Chunk] = deque()
        self._waiting: asyncio.Future[None] | None = None
        self._gone = ""
        self.name = name
        self.baud = baud

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._check()
        self._wire.send(data)

    async def read(self) -> Chunk:
        """Return the next bytes."""
        while not self._chunks:
            self._check()
            self._waiting = asyncio.get_running_loop().create_future()
            try:
                await self._waiting
            finally:
                self._waiting = None
        return self._chunks.popleft()

    def drain(self) -> bytes:
        """Return what has come and was not read, and forget it."""
        self._check()
        data = b"".join(chunk.data for chunk in self._chunks)
        self._chunks.clear()
        return data

    async def close(self) -> None:
        """Close it."""
        self.break_off("is closed")
        self._closed(self)

    def take(self, chunk: Chunk) -> None:
        """Take bytes that have come."""
        self._chunks.append(chunk)
        self._wake()

    def break_off(self, why: str) -> None:
        """Be of no use any more."""
        self._gone = self._gone or why
        self._chunks.clear()
        self._wake()

    def _check(self) -> None:
        if self._gone:
            raise InstrumentError(f"{self.name} {self._gone}; plug it in and open it again")

    def _wake(self) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(None)


def line_ns(count: int, baud: int) -> int:
    """Return how long bytes take on a line."""
    return count * BITS_PER_BYTE * 1_000_000_000 // baud
