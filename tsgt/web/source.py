"""Reads the stream of a master, for ever: a lost connection is tried again."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.recording import MAX_LINE_BYTES

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.web.state import MissionState

RETRY_S = 0.5

log = structlog.get_logger()


async def follow(path: Path, state: MissionState, clock: Clock) -> NoReturn:
    """Pass the lines of a stream socket to the state."""
    was_connected = True
    while True:
        problem = f"no stream at {path}"
        try:
            reader, writer = await asyncio.open_unix_connection(path, limit=MAX_LINE_BYTES)
        except OSError as error:
            problem += f" ({error.strerror or error}): does tsgt-master run?"
        else:
            log.info("stream_connected", path=str(path))
            was_connected = True
            try:
                problem = await _read(reader, state, clock)
            finally:
                writer.close()
                with contextlib.suppress(OSError):
                    await writer.wait_closed()
        state.disconnected(problem)
        if was_connected:
            log.warning("stream_disconnected", problem=problem)
        was_connected = False
        await clock.sleep_until(clock.monotonic_ns() + round(RETRY_S * 1e9))


async def _read(reader: asyncio.StreamReader, state: MissionState, clock: Clock) -> str:
    """Read until the end; return why it ended."""
    state.connected(clock.monotonic_ns() / 1e9)
    try:
        while line := await reader.readline():
            state.line(line, clock.monotonic_ns() / 1e9)
    except ValueError as error:  # no line of the stream, or one without end
        return f"not a stream of tsgt: {error}"
    except OSError as error:
        return f"the stream was lost: {error.strerror or error}"
    return "the stream has ended: the master was stopped or killed"
