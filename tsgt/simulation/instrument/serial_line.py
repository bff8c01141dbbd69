"""A serial line between a simulated total station and a program in the same process: transfer times, unplugging, faults."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import InstrumentError
from tsgt.station.serial import Chunk
from tsgt.station.serial.chunk_queue import ChunkQueue

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.simulation.instrument.total_station import SimulatedTotalStation
    from tsgt.simulation.kernel import Timeline
    from tsgt.station.serial import Port

GARBAGE = b"\x00\xff\x1a%R1\x81,7"
"""Noise bytes that begin like a response."""


class LineFault(StrEnum):
    """Fault of one response."""

    NONE = "none"
    """No fault."""
    TRUNCATED = "truncated"
    """The second half is lost."""
    GARBAGE = "garbage"
    """Noise bytes precede it."""
    CORRUPTED = "corrupted"
    """Bytes in its middle are changed."""
    DELAYED = "delayed"
    """It is delayed by seconds."""
    DUPLICATED = "duplicated"
    """It is sent twice."""
    SPLIT = "split"
    """The second half is delayed."""
    WRONG_DIGIT = "wrong-digit"
    """One digit is changed, which only a checksum detects."""
    DROPPED = "dropped"
    """It is lost."""


@dataclass(slots=True)
class LineFaults:
    """Faults of a line; may be changed at any time.

    Attributes
    ----------
    script
        Faults of the next responses, in order; later responses have none.
    """

    script: deque[LineFault] = field(default_factory=deque)
    delay_s: float = 4.0
    split_delay_s: float = 0.3
    drop_requests: bool = False  # whether requests are lost
    drop_responses: bool = False  # whether responses are lost

    def apply(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return the parts of a response that arrive, each with its delay in ns."""
        if self.drop_responses:
            return []
        fault = self.script.popleft() if self.script else LineFault.NONE
        half = len(data) // 2
        match fault:
            case LineFault.TRUNCATED:
                return [(0, data[:half])]
            case LineFault.GARBAGE:
                return [(0, GARBAGE + data)]
            case LineFault.CORRUPTED:
                return [(0, data[:half] + b"\x80\xfe" + data[half + 2 :])]
            case LineFault.DELAYED:
                return [(round(self.delay_s * 1e9), data)]
            case LineFault.DUPLICATED:
                return [(0, data), (0, data)]
            case LineFault.SPLIT:
                return [(0, data[:half]), (round(self.split_delay_s * 1e9), data[half:])]
            case LineFault.WRONG_DIGIT:
                return [(0, _with_wrong_digit(data))]
            case LineFault.DROPPED:
                return []
            case LineFault.NONE:
                return [(0, data)]


def _with_wrong_digit(data: bytes) -> bytes:
    """Return a response with one digit changed, at a position that depends on the response."""
    digits = [i for i in range(len(data)) if data[i : i + 1].isdigit()]
    if not digits:
        return data
    at = digits[sum(data) % len(digits)]
    return data[:at] + (b"1" if data[at : at + 1] != b"1" else b"7") + data[at + 1 :]


BITS_PER_BYTE = 10


class Wire:
    """Carries bytes between program and instrument at the line's bit rate; ``deliver`` gets those for the program."""

    def __init__(
        self,
        instrument: SimulatedTotalStation,
        timeline: Timeline,
        deliver: Callable[[bytes], None],
    ) -> None:
        self._instrument = instrument
        self._timeline = timeline
        self._deliver = deliver
        self._requests_until_ns = 0
        self._responses_until_ns = 0
        self._garbage = np.random.default_rng(0)
        self.host_baud = instrument.baud
        self.plugged = True
        self.faults = LineFaults()
        instrument.server.on_send = self._send_response

    def send(self, data: bytes) -> None:
        """Carry bytes from the program to the instrument."""
        arrives_ns = max(self._timeline.now_ns(), self._requests_until_ns) + line_ns(
            len(data), self.host_baud
        )
        self._requests_until_ns = arrives_ns
        if self.faults.drop_requests:
            return
        if self.host_baud != self._instrument.baud:
            # The instrument may take part of the garbage for a malformed request.
            self._timeline.call_at(arrives_ns, lambda: self._send_response(b"%R1P,3078,0:0\r\n"))
            data = self._randomise(data)
        self._timeline.call_at(arrives_ns, lambda: self._instrument.receive(data) if self.plugged else None)

    def _send_response(self, data: bytes) -> None:
        """Carry what the instrument sends."""
        now_ns = self._timeline.now_ns()
        for after_ns, part in self.faults.apply(data):
            begins_ns = max(now_ns + after_ns, self._responses_until_ns)
            arrives_ns = begins_ns + line_ns(len(part), self._instrument.baud)
            if not after_ns:
                self._responses_until_ns = arrives_ns
            self._timeline.call_at(arrives_ns, partial(self._arrive, part))

    def _arrive(self, data: bytes) -> None:
        if self.plugged:
            self._deliver(data if self.host_baud == self._instrument.baud else self._randomise(data))

    def _randomise(self, data: bytes) -> bytes:
        return self._garbage.integers(128, 256, len(data), dtype=np.uint8).tobytes()


class SimulatedLine:
    """A serial line in memory, for one program at a time; ``clock`` is that of the program's host."""

    def __init__(
        self, instrument: SimulatedTotalStation, timeline: Timeline, clock: Clock, *, name: str = "simulated"
    ) -> None:
        self._clock = clock
        self._name = name
        self._wire = Wire(instrument, timeline, self._deliver)
        self._port: _SimulatedPort | None = None

    @property
    def faults(self) -> LineFaults:
        """Faults of the instrument's responses."""
        return self._wire.faults

    @property
    def plugged(self) -> bool:
        """Whether the cable is plugged in; unplugging disconnects the open port."""
        return self._wire.plugged

    @plugged.setter
    def plugged(self, plugged: bool) -> None:
        self._wire.plugged = plugged
        if not plugged and self._port is not None:
            self._port.disconnect("was unplugged")
            self._port = None

    async def open(self, baud: int) -> Port:
        """Open the program's end at a bit rate in bits per second.

        Raises
        ------
        InstrumentError
            The cable is unplugged, or the port is open already.
        """
        if not self._wire.plugged:
            raise InstrumentError(f"{self._name}: no such device; plug the cable in")
        if self._port is not None:
            raise InstrumentError(f"{self._name} is already open")
        self._wire.host_baud = baud
        self._port = _SimulatedPort(self._wire, self._name, baud, self._closed)
        return self._port

    def _closed(self, port: _SimulatedPort) -> None:
        if self._port is port:
            self._port = None

    def _deliver(self, data: bytes) -> None:
        if self._port is not None:
            self._port.receive(Chunk(data, self._clock.monotonic_ns()))


class _SimulatedPort:
    """The program's end of a line."""

    def __init__(self, wire: Wire, name: str, baud: int, closed: Callable[[_SimulatedPort], None]) -> None:
        self._wire = wire
        self._closed = closed
        self._received = ChunkQueue()
        self.name = name
        self.baud = baud

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._received.check()
        self._wire.send(data)

    async def read(self) -> Chunk:
        """Return the next bytes."""
        return await self._received.read()

    def drain(self) -> bytes:
        """Return and discard the bytes that have arrived."""
        return self._received.drain()

    async def close(self) -> None:
        """Close the port."""
        self.disconnect("is closed")
        self._closed(self)

    def receive(self, chunk: Chunk) -> None:
        """Queue bytes that have arrived."""
        self._received.put(chunk)

    def disconnect(self, why: str) -> None:
        """Make all further calls fail."""
        self._received.clear()
        self._received.fail(f"{self.name} {why}; plug it in and open it again")


def line_ns(count: int, baud: int) -> int:
    """Return the transfer time of ``count`` bytes in ns."""
    return count * BITS_PER_BYTE * 1_000_000_000 // baud
