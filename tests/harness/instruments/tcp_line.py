"""A simulated total station behind a TCP server, in real time: an instrument in the network for other programs."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Self

from harness.instruments.network_line import SimulatedNetwork

from tsgt.simulation.kernel import LoopTimeline

if TYPE_CHECKING:
    from types import TracebackType

    import numpy as np

    from tsgt.clock import Clock
    from tsgt.simulation.instrument import SimulatedTotalStation
    from tsgt.station.serial import Port


class TcpLine:
    """A server on this computer, for one client at a time as at a real instrument; an async context manager.

    ``port``: number of its port, after entering.
    """

    def __init__(self, instrument: SimulatedTotalStation, clock: Clock, rng: np.random.Generator) -> None:
        self._instrument = instrument
        self._clock = clock
        self._rng = rng
        self._server: asyncio.Server | None = None
        self._network: SimulatedNetwork | None = None
        self._connected: asyncio.StreamWriter | None = None
        self.port = 0

    async def __aenter__(self) -> Self:
        """Listen."""
        timeline = LoopTimeline(asyncio.get_running_loop())
        self._network = SimulatedNetwork(self._instrument, timeline, self._clock, self._rng)
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the server and the connection."""
        assert self._server is not None  # entered
        self._server.close()
        self.drop()
        await self._server.wait_closed()

    def drop(self) -> None:
        """Reset the connection."""
        if self._connected is not None:
            self._connected.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert self._network is not None  # entered
        if self._connected is not None:  # a second client
            writer.close()
            return
        self._connected = writer
        port = await self._network.open(0)
        sending = asyncio.create_task(self._send(port, writer))
        try:
            while data := await reader.read(4096):
                port.write(data)
        except OSError:
            pass  # reset by the client
        finally:
            sending.cancel()
            await port.close()
            writer.close()
            self._connected = None

    @staticmethod
    async def _send(port: Port, writer: asyncio.StreamWriter) -> None:
        while True:
            writer.write((await port.read()).data)
