from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from harness.readers.web import HELLO, SETUP_LINE, in_real_time, pose, status
from structlog.testing import capture_logs

from tsgt.clock import SystemClock
from tsgt.master.stream_server import StreamServer
from tsgt.recording import encode_line
from tsgt.web import source
from tsgt.web.mission.state import MissionState

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

LINES = (SETUP_LINE, encode_line(pose(1.0)))
STATUS_LINE = encode_line(status(1.0))


@asynccontextmanager
async def master(path: Path, *lines: bytes, hello: bytes = HELLO) -> AsyncIterator[None]:
    """Serve lines again and again, so that the newest pose is never old."""

    async def publish(server: StreamServer) -> None:
        while True:
            for line in lines:
                server.publish(line)
            await asyncio.sleep(0.05)

    async with StreamServer(path, hello) as server:
        task = asyncio.create_task(publish(server))
        yield
        task.cancel()


@asynccontextmanager
async def following(path: Path) -> AsyncIterator[MissionState]:
    """Follow a stream."""
    state = MissionState(path.name)
    task = asyncio.create_task(source.follow(path, state, SystemClock()))
    try:
        yield state
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def shown(state: MissionState, words: str, cause: str = "") -> None:
    """Wait for a verdict."""
    async with asyncio.timeout(5):
        while True:
            verdict = state.view(SystemClock().monotonic_ns() / 1e9)["verdict"]
            if verdict["words"] == words and cause in verdict["cause"]:
                return
            await asyncio.sleep(0.01)


@pytest.mark.slow
@in_real_time
async def test_master_that_comes_later_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And one that went is told as gone, not as never there."""
    monkeypatch.setattr(source, "RETRY_S", 0.02)
    path = tmp_path / "s"
    async with following(path) as state:
        await shown(state, "STREAM STOPPED", "does tsgt-master run?")
        async with master(path, *LINES):
            await shown(state, "GOOD")
        await asyncio.sleep(0.1)
        await shown(state, "STREAM STOPPED", "the stream has ended")


@pytest.mark.slow
@in_real_time
async def test_line_of_a_newer_master_is_skipped(tmp_path: Path) -> None:
    """With a value that this program does not know; the page says so, and the log once."""
    newer = STATUS_LINE.replace(b'"status":"ok"', b'"status":"levitating"')
    path = tmp_path / "s"
    with capture_logs() as logged:
        async with master(path, *LINES, newer, b"{"), following(path) as state:
            await shown(state, "CARE", "status lines cannot be read: restart or update tsgt web")
    assert [each["event"] for each in logged].count("stream_line_rejected") == 1


def test_clock_of_the_mission_counts_suspension(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else lines that waited meanwhile would be no older than those of now."""
    monkeypatch.setattr(time, "monotonic_ns", lambda: 2_000_000_000)
    monkeypatch.setattr(time, "clock_gettime_ns", {time.CLOCK_BOOTTIME: 9_000_000_000}.__getitem__)
    assert source.ArrivalClock().monotonic_ns() == 9_000_000_000


@in_real_time
async def test_other_program_is_no_stream(tmp_path: Path) -> None:
    """What answers at the socket is something else."""
    path = tmp_path / "s"
    async with master(path, hello=b"SSH-2.0-OpenSSH"), following(path) as state:
        await shown(state, "STREAM STOPPED", "not a stream of tsgt")
