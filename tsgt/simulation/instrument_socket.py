"""A simulated instrument for another process: JSON lines over a UNIX socket.

Both processes share CLOCK_MONOTONIC, so a reading keeps the instant at which it was taken. Nothing in here needs
scipy: a client that talks to a simulated instrument is as small as one in the field.
"""

from __future__ import annotations

import asyncio
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field

from tsgt.errors import InstrumentError
from tsgt.model import Status  # noqa: TC001 (pydantic looks it up when the program runs)
from tsgt.recording import decode, encode_line
from tsgt.recording.format import Typed
from tsgt.service import UnixListener
from tsgt.simulation.air_lines import LineBuffer
from tsgt.station.instrument import Condition, Instrument, Reading

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.radio.orders import Direction
    from tsgt.station.instrument import Atmosphere

ANSWER_TIMEOUT_S = 10.0
"""How long the instrument may take for anything that it is told; a single measurement takes 2 s."""

QUEUE_READINGS = 16
"""How many readings wait for :meth:`RemoteInstrument.read`; the oldest goes first."""

Finite = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tell:
    """The client tells the instrument what to do; each line gets one :class:`Answer`."""

    type: Literal["tell"] = "tell"
    command: Literal["connect", "track", "direct", "measure"]
    prism: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadingLine:
    """A reading; the fields are those of :class:`~tsgt.station.instrument.Reading`. Sent unasked while tracking."""

    type: Literal["reading"] = "reading"
    at_ns: int
    prism: int | None
    horizontal_angle_rad: Finite
    zenith_angle_rad: Finite
    slope_distance_m: Finite | None
    status: Status
    raw_status: int
    instrument_time_ns: int | None

    @classmethod
    def of(cls, reading: Reading) -> Self:
        """Make the line of a reading."""
        return cls(
            at_ns=reading.at_ns,
            prism=reading.prism,
            horizontal_angle_rad=reading.horizontal_angle_rad,
            zenith_angle_rad=reading.zenith_angle_rad,
            slope_distance_m=reading.slope_distance_m,
            status=reading.status,
            raw_status=reading.raw_status,
            instrument_time_ns=reading.instrument_time_ns,
        )

    def reading(self) -> Reading:
        """Make the reading of a line."""
        return Reading(
            at_ns=self.at_ns,
            prism=self.prism,
            horizontal_angle_rad=self.horizontal_angle_rad,
            zenith_angle_rad=self.zenith_angle_rad,
            slope_distance_m=self.slope_distance_m,
            status=self.status,
            raw_status=self.raw_status,
            instrument_time_ns=self.instrument_time_ns,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What became of what the instrument was told.

    Attributes
    ----------
    error
        Why it was not done; empty when it was. Also sent unasked, when the tracking ends.
    description
        Answer to ``connect``.
    shot
        Answer to ``measure``.
    """

    type: Literal["answer"] = "answer"
    error: str = ""
    description: str = ""
    shot: ReadingLine | None = None


class InstrumentServer:
    """Serves an instrument to one client at a time, the one that came last; an async context manager.

    Parameters
    ----------
    path
        The socket. A stale one of an earlier run is replaced.
    instrument
        What is served.

    Raises
    ------
    StreamError
        On entering: another program serves the socket, or it cannot be made.
    """

    def __init__(self, path: Path, instrument: Instrument) -> None:
        self._path = path
        self._instrument = instrument
        self._client: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._tracking = False

    async def __aenter__(self) -> Self:
        self._listener = UnixListener(self._path, 0o660)
        self._server = await asyncio.start_unix_server(self._serve, sock=self._listener.socket)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._listener.remove()
        self._server.close()
        while self._tasks:
            for task in self._tasks:
                task.cancel()
            await asyncio.wait(self._tasks)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 (we are in one)
        self._tasks.add(task)
        previous, self._client = self._client, task
        pump: asyncio.Task[None] | None = None
        try:
            if previous is not None and not previous.done():
                previous.cancel()
                await asyncio.wait([previous])
            while line := await reader.readline():
                await _end(pump)
                answer = await self._do(decode(Tell, line))
                writer.write(encode_line(answer) + b"\n")
                pump = asyncio.create_task(self._pump(writer)) if self._tracking else None
                await writer.drain()
        except (OSError, ValueError, asyncio.CancelledError):
            pass  # it is gone, talks nonsense, or another one has come
        finally:
            await _end(pump)
            writer.close()
            self._tasks.discard(task)

    async def _do(self, told: Tell) -> Answer:
        self._tracking = False
        try:
            match told.command:
                case "connect":
                    return Answer(description=await self._instrument.connect())
                case "track":
                    await self._instrument.track(told.prism or 0)
                    self._tracking = True
                case "direct":
                    await self._instrument.direct()
                case "measure":
                    return Answer(shot=ReadingLine.of(await self._instrument.measure()))
        except InstrumentError as error:
            return Answer(error=str(error))
        return Answer()

    async def _pump(self, writer: asyncio.StreamWriter) -> None:
        """Send readings as they come, as instruments do that call back."""
        try:
            while True:
                reading = await self._instrument.read()
                writer.write(encode_line(ReadingLine.of(reading)) + b"\n")
                await writer.drain()
        except InstrumentError as error:
            writer.write(encode_line(Answer(error=str(error))) + b"\n")
        except OSError:
            pass  # the client is gone


async def _end(task: asyncio.Task[None] | None) -> None:
    if task is not None:
        task.cancel()
        await asyncio.wait([task])


class RemoteInstrument:
    """The :class:`~tsgt.station.instrument.Instrument` that an :class:`InstrumentServer` serves.

    Parameters
    ----------
    path
        The server's socket.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._line: _Line | None = None

    async def connect(self) -> str:
        """Connect to the server, which drops whoever was connected before."""
        await self.close()
        loop = asyncio.get_running_loop()
        try:
            _, self._line = await loop.create_unix_connection(
                lambda: _Line(self._path), os.fspath(self._path)
            )
        except OSError as error:
            raise InstrumentError(
                f"{self._path}: no simulated instrument answers ({error.strerror}); start one"
            ) from error
        return (await self._told("connect")).description

    async def track(self, prism: int, towards: Direction | None = None) -> None:  # noqa: ARG002 (it finds it anyway)
        """Track a prism."""
        await self._told("track", prism)

    async def read(self) -> Reading:
        """Return the oldest reading that waits, or the next one."""
        item = await self._connected().readings.get()
        if isinstance(item, InstrumentError):
            raise item
        return item

    async def direct(self) -> None:
        """Stop tracking."""
        await self._told("direct")

    async def measure(self) -> Reading:
        """Measure once."""
        shot = (await self._told("measure")).shot
        if shot is None:
            raise InstrumentError(f"{self._path}: the simulated instrument gives no measurement")
        return shot.reading()

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:  # noqa: ARG002 (see the instrument)
        """Do nothing."""
        self._connected()

    @property
    def condition(self) -> Condition:
        """Nothing ever is the matter with it."""
        return Condition()

    @property
    def record(self) -> None:
        """It has no settings."""

    async def close(self) -> None:
        """Leave the server."""
        line, self._line = self._line, None
        if line is not None:
            await line.close()

    def _connected(self) -> _Line:
        if self._line is None:
            raise InstrumentError(f"{self._path}: not connected; call connect first")
        return self._line

    async def _told(
        self, command: Literal["connect", "track", "direct", "measure"], prism: int | None = None
    ) -> Answer:
        answer = await self._connected().tell(Tell(command=command, prism=prism))
        if answer.error:
            raise InstrumentError(answer.error)
        return answer


class _Line(asyncio.Protocol):
    """Lines to and from the server."""

    transport: asyncio.WriteTransport

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lines = LineBuffer()
        self._answer: asyncio.Future[Answer] | None = None
        self._lost: InstrumentError | None = None
        self._closed = asyncio.Event()
        self.readings: asyncio.Queue[Reading | InstrumentError] = asyncio.Queue(QUEUE_READINGS)

    async def tell(self, told: Tell) -> Answer:
        """Send a line and wait for its answer; what was read before and nobody has taken is dropped."""
        if self._lost is not None:
            raise self._lost
        self._answer = asyncio.get_running_loop().create_future()
        self.transport.write(encode_line(told) + b"\n")
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT_S):
                return await self._answer
        except TimeoutError:
            raise InstrumentError(f"{self._path}: the simulated instrument does not answer") from None
        finally:
            self._answer = None

    async def close(self) -> None:
        """Close the connection."""
        self.transport.close()
        await self._closed.wait()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        assert isinstance(transport, asyncio.WriteTransport)  # noqa: S101 (asyncio's promise for a stream socket)
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        """Take what the server says."""
        try:
            for line in self._lines.lines(data):
                if decode(Typed, line).type == "reading":
                    self._put(decode(ReadingLine, line).reading())
                else:
                    self._answered(decode(Answer, line))
        except ValueError as error:
            self._lose(f"it says what no simulated instrument says ({error})")
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 (it is gone in any case)
        """Tell whoever waits."""
        self._lose("it has closed the connection")
        self._closed.set()

    def _answered(self, answer: Answer) -> None:
        if self._answer is not None and not self._answer.done():
            while not self.readings.empty():  # from before it was told something else
                self.readings.get_nowait()
            self._answer.set_result(answer)
        elif answer.error:
            self._put(InstrumentError(answer.error))

    def _put(self, item: Reading | InstrumentError) -> None:
        if self.readings.full():
            self.readings.get_nowait()
        self.readings.put_nowait(item)

    def _lose(self, reason: str) -> None:
        if self._lost is not None:
            return
        self._lost = InstrumentError(f"{self._path}: the simulated instrument is gone: {reason}")
        self._put(self._lost)
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(self._lost)
