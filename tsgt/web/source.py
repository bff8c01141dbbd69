"""Reads the stream of a master, for ever: a lost connection is tried again."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, NoReturn, Protocol

import structlog

from tsgt.client import monotonic_ns
from tsgt.clock import SystemClock
from tsgt.recording import MAX_LINE_BYTES
from tsgt.service import LogLimiter

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.clock import Clock

RETRY_S = 0.5

log = structlog.get_logger()


class ArrivalClock(SystemClock):
    """The machine's clocks for the arrival of lines: the monotonic one also counts while the computer is suspended.

    Lines that waited meanwhile are late then, and not of now. Only Linux has that clock.
    """

    def monotonic_ns(self) -> int:
        """Return CLOCK_BOOTTIME in nanoseconds, CLOCK_MONOTONIC where there is none."""
        return monotonic_ns() if hasattr(time, "CLOCK_BOOTTIME") else super().monotonic_ns()


class Follower(Protocol):
    """Who gets the lines: the state of the page, with what else is served."""

    def connected(self, now_s: float, /) -> None:
        """Take note of a new connection to the stream."""

    def disconnected(self, problem: str, /) -> None:
        """Take note that there is none; ``problem``: why, in one line."""

    def line(self, data: bytes, now_s: float, /) -> None:
        """Take a line; raises ValueError if it is none."""


async def follow(path: Path, follower: Follower, clock: Clock) -> NoReturn:
    """Pass the lines of a stream socket on; while there is none, what happened last is the problem."""
    limiter = LogLimiter()
    problem = ""
    was_connected = True
    while True:
        try:
            reader, writer = await asyncio.open_unix_connection(path, limit=MAX_LINE_BYTES)
        except OSError as error:
            problem = problem or f"no stream at {path} ({error.strerror or error}): does tsgt-master run?"
        else:
            log.info("stream_connected", path=str(path))
            was_connected = True
            try:
                problem = await _read(reader, follower, clock, limiter)
            finally:
                writer.close()
                with contextlib.suppress(OSError):
                    await writer.wait_closed()
        follower.disconnected(problem)
        if was_connected:
            log.warning("stream_disconnected", problem=problem)
        was_connected = False
        await clock.sleep_until(clock.monotonic_ns() + round(RETRY_S * 1e9))


async def _read(reader: asyncio.StreamReader, follower: Follower, clock: Clock, limiter: LogLimiter) -> str:
    """Read until the end; return why it ended."""
    follower.connected(clock.monotonic_ns() / 1e9)
    greeted = False
    while True:
        try:
            line = await reader.readline()
        except (OSError, ValueError) as error:  # ValueError: a line without end
            return f"the stream was lost: {error}"
        if not line:
            return "the stream has ended: the master was stopped or killed"
        now_ns = clock.monotonic_ns()
        try:
            follower.line(line, now_ns / 1e9)
        except ValueError as error:
            if not greeted:
                return f"not a stream of tsgt: {error}"
            # What is missing then shows by its age.
            if limiter.allows("stream_line_rejected", now_ns):
                log.warning("stream_line_rejected", error=str(error))
        greeted = True
