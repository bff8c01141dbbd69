"""A TCP connection to a simulated total station over a Wi-Fi: delays, stalls, lost connections, other servers.

TCP delivers bytes in order, whole, and late: a packet that waits holds back those behind it, and they arrive together.
"""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING

from tsgt.errors import InstrumentError
from tsgt.station.serial import Chunk

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from tsgt.clock import Clock
    from tsgt.simulation.instrument import SimulatedTotalStation
    from tsgt.simulation.kernel import Timeline
    from tsgt.station.serial import Port

_CONNECT_TIMEOUT_NS = 5_000_000_000
_PARETO_SHAPE = 1.5  # of the jitter: a finite mean, an infinite variance
_BURST_MS = (200.0, 800.0)
_NAME = "tcp://simulated:1212"


class PeerKind(StrEnum):
    """What is at the other end of a new connection."""

    INSTRUMENT = "instrument"
    """The instrument."""
    REFUSED = "refused"
    """Nothing listens."""
    UNREACHABLE = "unreachable"
    """No answer at all."""
    SILENT = "silent"
    """A server that accepts and never answers: an instrument with another client."""
    CLOSING = "closing"
    """A server that closes at once: likewise."""
    FOREIGN = "foreign"
    """A server that speaks something else."""


@dataclass(slots=True)
class NetworkFaults:
    """Delays and faults of a network; may be changed at any time.

    Attributes
    ----------
    request_ms, response_ms
        Fastest delay of either direction.
    jitter_ms
        Mean of the additional delay, which has a heavy tail.
    burst_share
        Share of the packets that are 200 to 800 ms late.
    pieces
        Number of segments that a response is cut into, at random places.
    stalled_until_ns
        Nothing arrives in either direction before this time.
    half_open
        Whether packets are lost for ever, without notice.
    peer
        What a new connection meets.
    """

    request_ms: float = 2.0
    response_ms: float = 2.0
    jitter_ms: float = 1.0
    burst_share: float = 0.0
    pieces: int = 1
    stalled_until_ns: int = 0
    half_open: bool = False
    peer: PeerKind = PeerKind.INSTRUMENT

    def delay_ns(self, fastest_ms: float, rng: np.random.Generator) -> int:
        """Return the delay of a packet."""
        delay_ms = fastest_ms + self.jitter_ms * (_PARETO_SHAPE - 1) * rng.pareto(_PARETO_SHAPE)
        if rng.random() < self.burst_share:
            delay_ms += rng.uniform(*_BURST_MS)
        return round(min(delay_ms, 30_000.0) * 1e6)


class SimulatedNetwork:
    """A network between an instrument and one program; ``clock`` is that of the program's host."""

    def __init__(
        self,
        instrument: SimulatedTotalStation,
        timeline: Timeline,
        clock: Clock,
        rng: np.random.Generator,
    ) -> None:
        self._instrument = instrument
        self._timeline = timeline
        self._clock = clock
        self._rng = rng
        self._port: _SimulatedConnection | None = None
        self._request_at_ns = self._response_at_ns = 0
        self.faults = NetworkFaults()
        instrument.server.on_send = self._respond

    async def open(self, _baud: int) -> Port:
        """Connect; raises InstrumentError if nothing answers."""
        faults = self.faults
        await self._sleep(faults.delay_ns(faults.request_ms + faults.response_ms, self._rng))
        stall_ns = faults.stalled_until_ns - self._timeline.now_ns()
        if faults.half_open or faults.peer is PeerKind.UNREACHABLE or stall_ns > _CONNECT_TIMEOUT_NS:
            await self._sleep(_CONNECT_TIMEOUT_NS)
            raise InstrumentError(f"{_NAME}: no answer")
        if stall_ns > 0:
            await self._sleep(stall_ns)
        if faults.peer is PeerKind.REFUSED:
            raise InstrumentError(f"{_NAME} cannot be connected: nothing listens there")
        if self._port is not None:
            raise InstrumentError(f"{_NAME} is already connected")
        self._request_at_ns = self._response_at_ns = 0
        self._port = _SimulatedConnection(_NAME, self._send, self._closed)
        if faults.peer is PeerKind.CLOSING:
            self.drop()
            raise InstrumentError(f"{_NAME}: the connection was closed at once")
        return self._port

    def drop(self) -> None:
        """Break the connection: what is on its way is lost."""
        port, self._port = self._port, None
        if port is not None:
            port.disconnect("the connection is lost")

    def _closed(self, port: _SimulatedConnection) -> None:
        if self._port is port:
            self._port = None

    async def _sleep(self, duration_ns: int) -> None:
        await asyncio.sleep(duration_ns / 1e9)

    def _send(self, data: bytes) -> None:
        """Carry a request."""
        faults = self.faults
        if faults.half_open or faults.peer is PeerKind.SILENT:
            return
        at_ns = self._arrival_ns(faults.request_ms, self._request_at_ns)
        self._request_at_ns = at_ns
        if faults.peer is PeerKind.FOREIGN:
            self._respond(b"SSH-2.0-OpenSSH_9.2\r\n")
            return
        self._timeline.call_at(at_ns, partial(self._arrive_at_instrument, data, self._port))

    def _arrive_at_instrument(self, data: bytes, port: _SimulatedConnection | None) -> None:
        if port is self._port and not self.faults.half_open:
            self._instrument.receive(data)

    def _respond(self, data: bytes) -> None:
        """Carry a response, in segments."""
        if self.faults.half_open or self._port is None:
            return
        cuts = sorted(int(cut) for cut in self._rng.integers(0, len(data) + 1, self.faults.pieces - 1))
        for first, last in zip([0, *cuts], [*cuts, len(data)], strict=True):
            if first < last:
                self._response_at_ns = self._arrival_ns(self.faults.response_ms, self._response_at_ns)
                self._timeline.call_at(
                    self._response_at_ns, partial(self._arrive, data[first:last], self._port)
                )

    def _arrival_ns(self, fastest_ms: float, before_ns: int) -> int:
        sent_ns = max(self._timeline.now_ns(), self.faults.stalled_until_ns)
        return max(sent_ns + self.faults.delay_ns(fastest_ms, self._rng), before_ns)

    def _arrive(self, data: bytes, port: _SimulatedConnection) -> None:
        stall_ns = self.faults.stalled_until_ns
        if stall_ns > self._timeline.now_ns():  # it has begun meanwhile
            self._timeline.call_at(stall_ns, partial(self._arrive, data, port))
        elif not self.faults.half_open:
            port.receive(Chunk(data, self._clock.monotonic_ns()))


class _SimulatedConnection:
    """The program's end."""

    baud = None

    def __init__(
        self, name: str, send: Callable[[bytes], None], closed: Callable[[_SimulatedConnection], None]
    ) -> None:
        self._send = send
        self._closed = closed
        self._chunks: deque[Chunk] = deque()
        self._waiter: asyncio.Future[None] | None = None
        self._reason = ""
        self.name = name

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._check()
        self._send(data)

    async def read(self) -> Chunk:
        """Return the next bytes."""
        while not self._chunks:
            self._check()
            self._waiter = asyncio.get_running_loop().create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self._chunks.popleft()

    def drain(self) -> bytes:
        """Return and discard the bytes that have arrived."""
        self._check()
        data = b"".join(chunk.data for chunk in self._chunks)
        self._chunks.clear()
        return data

    async def close(self) -> None:
        """Close the connection."""
        self.disconnect("is closed")
        self._closed(self)

    def receive(self, chunk: Chunk) -> None:
        """Queue bytes that have arrived; those of one moment are one chunk."""
        if self._reason:
            return
        if self._chunks and self._chunks[-1].at_ns == chunk.at_ns:
            chunk = Chunk(self._chunks.pop().data + chunk.data, chunk.at_ns)
        self._chunks.append(chunk)
        self._wake()

    def disconnect(self, why: str) -> None:
        """Make all further calls fail."""
        self._reason = self._reason or why
        self._chunks.clear()
        self._wake()

    def _check(self) -> None:
        if self._reason:
            raise InstrumentError(f"{self.name}: {self._reason}")

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)
