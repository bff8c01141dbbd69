"""A cable between a simulated total station and a program in the same process, with the pace of a real one.

Bytes take as long as at the line's speed, in both directions. The cable can be pulled, the two ends may have different
speeds, and what goes wrong on cables can be ordered (:class:`~tsgt.simulation.line_faults.LineFaults`).
"""

from __future__ import annotations

import asyncio
from collections import deque
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import InstrumentError
from tsgt.simulation.line_faults import LineFaults
from tsgt.station.port import Chunk

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.simulation.timeline import Timeline
    from tsgt.simulation.total_station import SimulatedTotalStation
    from tsgt.station.port import Port

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
