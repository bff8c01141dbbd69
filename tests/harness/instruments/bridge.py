"""Bridge programs in memory: a scripted one, and one that serves any instrument."""

from __future__ import annotations

import asyncio
import json
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from tsgt.errors import InstrumentError
from tsgt.radio import Direction
from tsgt.station import Atmosphere

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.clock import Clock
    from tsgt.service import Listener
    from tsgt.station import Instrument, Reading

HELLO = {"type": "hello", "bridge": 1, "make": "Fake", "stamps": "host"}
COMMANDS = ["track", "direct", "measure", "atmosphere"]


class FakeProgram:
    """A scripted program that responds ``done`` to every command by default.

    Attributes
    ----------
    commands
        All commands received.
    on_command
        Responds to a command.
    """

    def __init__(self, listener: Listener, clock: Clock) -> None:
        self._listener = listener
        self._clock = clock
        self.commands: list[dict[str, Any]] = []
        self.on_command: Callable[[dict[str, Any]], None] = self.done
        self.ended = False

    def print_lines(self, *records: dict[str, Any] | bytes) -> None:
        """Print lines in one piece."""
        self.print(b"".join(_line(record) + b"\n" for record in records))

    def print(self, data: bytes) -> None:
        """Print bytes."""
        if not self.ended:
            self._listener.output_received(data, self._clock.monotonic_ns())

    def measure(self, distance_m: float = 10.0, **more: Any) -> None:
        """Print a measurement of this moment."""
        self.print_lines(self.measurement(distance_m, **more))

    def measurement(self, distance_m: float = 10.0, **more: Any) -> dict[str, Any]:
        """Return the line of a measurement of this moment."""
        now_ns = self._clock.monotonic_ns()
        return measured(distance_m, host_time_ns=now_ns) | more

    def done(self, command: dict[str, Any], error: str = "") -> None:
        """Respond to a command."""
        self.print_lines({"type": "done", "id": command["id"], "error": error})

    def exit(self, how: str = "exit status 1") -> None:
        """End."""
        self.ended = True
        self._listener.exited(how)

    # --- Program ----------------------------------------------------------------------------------------------

    def write(self, data: bytes) -> None:
        """Receive commands."""
        for line in data.splitlines():
            command = json.loads(line)
            self.commands.append(command)
            self.on_command(command)

    def kill(self) -> None:
        """End."""
        self.ended = True

    async def terminate(self) -> None:
        """End."""
        self.ended = True


class FakeStart:
    """Starts scripted programs, each of which prints ``first_lines`` at once; ``programs`` are all that were started."""

    def __init__(self, clock: Clock, *first_lines: dict[str, Any] | bytes) -> None:
        self._clock = clock
        self._first_lines = first_lines
        self.programs: list[FakeProgram] = []

    async def __call__(self, command: Sequence[str], listener: Listener) -> FakeProgram:
        """Start one."""
        del command
        program = FakeProgram(listener, self._clock)
        self.programs.append(program)
        program.print_lines(*self._first_lines)
        return program


class ServedInstrument:
    """Starts a program that serves an instrument, as one with a manufacturer's library would."""

    def __init__(self, instrument: Instrument, clock: Clock) -> None:
        self._instrument = instrument
        self._clock = clock

    async def __call__(self, command: Sequence[str], listener: Listener) -> _Serving:
        """Start it."""
        del command
        return _Serving(self._instrument, listener, self._clock)


class _Serving:
    """The running program."""

    def __init__(self, instrument: Instrument, listener: Listener, clock: Clock) -> None:
        self._instrument = instrument
        self._listener = listener
        self._clock = clock
        self._commands: asyncio.Queue[bytes] = asyncio.Queue()
        self._reading: asyncio.Task[None] | None = None
        self._task = asyncio.create_task(self._run())

    def write(self, data: bytes) -> None:
        """Queue a command."""
        self._commands.put_nowait(data)

    def kill(self) -> None:
        """End."""
        self._task.cancel()

    async def terminate(self) -> None:
        """End."""
        self._task.cancel()
        await asyncio.wait([self._task])

    async def _run(self) -> None:
        try:
            name = await self._instrument.connect()
            self._print(HELLO | {"make": name, "commands": COMMANDS})
            while True:
                command = json.loads(await self._commands.get())
                if command["type"] != "atmosphere":
                    await self._stop()
                await self._do(command)
        except InstrumentError as error:
            self._listener.exited(f"exit status 1: {error}")
        finally:
            await self._stop()
            await self._instrument.close()

    async def _do(self, command: dict[str, Any]) -> None:
        instrument, tracked = self._instrument, False
        try:
            match command:
                case {"type": "track", "prism": prism, "towards": None}:
                    await instrument.track(prism)
                    tracked = True
                case {"type": "track", "prism": prism, "towards": towards}:
                    await instrument.track(prism, Direction(**towards))
                    tracked = True
                case {"type": "direct"}:
                    await instrument.direct()
                case {"type": "measure", "id": number}:
                    measured = _fields(await instrument.measure())
                    self._print({"type": "shot", "id": number} | measured)
                    return
                case {"type": "atmosphere", "temperature_c": temperature_c, "pressure_hpa": pressure_hpa}:
                    await instrument.set_atmosphere(
                        Atmosphere(temperature_c=temperature_c, pressure_hpa=pressure_hpa)
                    )
        except InstrumentError as error:
            self._print({"type": "done", "id": command["id"], "error": str(error)})
            return
        self._print({"type": "done", "id": command["id"]})
        if tracked:
            self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        try:
            while True:
                reading = await self._instrument.read()
                self._print({"type": "measurement", "prism": reading.prism} | _fields(reading))
        except InstrumentError as error:
            self._listener.exited(f"exit status 1: {error}")

    async def _stop(self) -> None:
        task, self._reading = self._reading, None
        if task is not None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    def _print(self, record: dict[str, Any]) -> None:
        self._listener.output_received(_line(record) + b"\n", self._clock.monotonic_ns())


def measured(distance_m: float = 10.0, **more: Any) -> dict[str, Any]:
    """Return the line of a measurement."""
    values = {"horizontal_angle_rad": 1.0, "zenith_angle_rad": 1.5, "slope_distance_m": distance_m}
    return {"type": "measurement", "status": "ok"} | values | more


def _fields(reading: Reading) -> dict[str, Any]:
    return {
        "horizontal_angle_rad": reading.horizontal_angle_rad,
        "zenith_angle_rad": reading.zenith_angle_rad,
        "slope_distance_m": reading.slope_distance_m,
        "status": reading.status,
        "raw_status": reading.raw_status,
        "host_time_ns": reading.at_ns,
        "instrument_time_ns": reading.instrument_time_ns,
    }


def _line(record: dict[str, Any] | bytes) -> bytes:
    return record if isinstance(record, bytes) else json.dumps(record).encode()
