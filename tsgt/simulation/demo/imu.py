"""The robot's IMU of a demonstration: a socket with the lines of its program, and the program that prints them."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.simulation.imu import ImuProgram

_PROGRAM = """
import socket, sys
lines = socket.socket(socket.AF_UNIX)
lines.connect(sys.argv[1])
while data := lines.recv(65536):
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()
"""


def imu_command(path: Path) -> tuple[str, ...]:
    """Return the command of a program that prints what comes from a socket."""
    return sys.executable, "-c", _PROGRAM, str(path)


class ImuServer:
    """Serves the lines of a simulated program, from the present on, to each process that connects."""

    def __init__(self, path: Path, program: ImuProgram, clock: Clock) -> None:
        self._path, self._program, self._clock = path, program, clock
        self._server: asyncio.Server | None = None
        self._serving: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        """Listen."""
        self._server = await asyncio.start_unix_server(self._connected, self._path)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop listening and serving."""
        assert self._server is not None  # noqa: S101 (entered)
        self._server.close()
        for task in self._serving:
            task.cancel()
        await asyncio.gather(*self._serving, return_exceptions=True)

    def _connected(self, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.create_task(self._serve(writer))
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)

    async def _serve(self, writer: asyncio.StreamWriter) -> None:
        try:
            writer.write(self._program.hello)
            for arrival_ns, line in self._program.lines(self._clock.monotonic_ns() / 1e9):
                await self._clock.sleep_until(arrival_ns)
                writer.write(line)
                await writer.drain()
        except OSError:
            pass  # the process has ended
        finally:
            writer.close()
