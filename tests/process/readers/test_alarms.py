"""Alarms with real programs and a web server that stalls: the master is not delayed, and nothing stays behind."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.files.records import EVENT
from harness.missions.processes import TIMEOUT_S
from structlog.testing import capture_logs

from tsgt.clock import SystemClock
from tsgt.config import AlarmsConfig
from tsgt.master.alarms import Alarms
from tsgt.service import run_command

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pytest

    from tsgt.recording import EventRecord

LOST = replace(EVENT, event="station_lost", message='station 2 lost: "$(touch owned)"\n', station=2)
NOTE = "import os, sys; print(os.environ['TSGT_MESSAGE'], sys.stdin.read(), sep='', end='', file=open(sys.argv[1], 'w'))"


async def served(config: AlarmsConfig, events: list[EventRecord], for_s: float) -> float:
    """Send events, and run for a while; return the longest delay of the event loop in s."""
    clock = SystemClock()
    alarms = Alarms(config, clock, time.time_ns)
    task = asyncio.create_task(alarms.run())
    longest_s = 0.0
    for event in events:
        alarms.take(event)
    until_s = time.monotonic() + for_s
    try:
        while (before_s := time.monotonic()) < until_s:
            await asyncio.sleep(0.01)
            longest_s = max(longest_s, time.monotonic() - before_s - 0.01)
    finally:
        task.cancel()
        await asyncio.wait([task])
    return longest_s


def outcomes(logs: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return what was logged of each target."""
    return [(log["event"], log["target"]) for log in logs]


async def delivered_to_both(note: Path, logs: Sequence[Mapping[str, Any]]) -> bytes:
    """Send an alarm to a command, which notes it, and to a web server; return what the server got."""
    received: asyncio.Queue[bytes] = asyncio.Queue()

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        (length,) = (line for line in head.decode().splitlines() if line.lower().startswith("content-length"))
        received.put_nowait(await reader.readexactly(int(length.partition(":")[2])))
        writer.write(b"HTTP/1.1 200 OK\r\n\r\n")
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    config = AlarmsConfig(
        site="yard",
        command=(sys.executable, "-c", NOTE, str(note)),
        webhook=f"http://127.0.0.1:{port}/alarm?key=1",
    )
    async with server, asyncio.timeout(TIMEOUT_S):
        task = asyncio.create_task(served(config, [LOST], TIMEOUT_S))
        body = await received.get()
        for _ in range(3000):
            if ("alarm_sent", "command") in outcomes(logs):
                break
            await asyncio.sleep(0.02)
        task.cancel()
        await asyncio.wait([task])
    return body


def test_alarm_reaches_a_command_and_a_web_server(tmp_path: Path) -> None:
    """The same line; nothing of it is executed."""
    note = tmp_path / "note"
    with capture_logs() as logs:
        body = asyncio.run(delivered_to_both(note, logs))
    assert json.loads(body)["message"] == LOST.message
    assert (tmp_path / "note").read_text() == LOST.message.strip() + body.decode() + "\n"


def test_stalled_server_delays_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the master nor the command; the program that waits for it is killed, also at the end."""
    monkeypatch.setattr("tsgt.service.command.COMMAND_TIMEOUT_S", 2.0)
    monkeypatch.setattr("tsgt.master.alarms.RETRY_DELAYS_S", ())
    with socket.create_server(("127.0.0.1", 0)) as listener, capture_logs() as logs:
        config = AlarmsConfig(
            site="yard",
            command=(sys.executable, "-c", NOTE, str(tmp_path / "note")),
            webhook=f"http://127.0.0.1:{listener.getsockname()[1]}/",
        )
        longest_s = asyncio.run(served(config, [LOST, replace(LOST, station=3)], 3.0))
    assert (tmp_path / "note").exists()
    assert outcomes(logs).count(("alarm_sent", "command")) == 2
    assert [log["error"] for log in logs if log["event"] == "alarm_failed"] == ["killed after 2 s"]
    assert longest_s < 1.0  # the program is killed after 2 s


def test_command_that_hangs_is_killed_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It neither reads its input nor ends."""
    monkeypatch.setattr("tsgt.service.command.COMMAND_TIMEOUT_S", 0.5)
    script = f"(sleep 30; touch {tmp_path}/late) & echo $! > {tmp_path}/pid; sleep 30"
    problem = asyncio.run(run_command(("sh", "-c", script), {}, stdin=b"x" * 1_000_000))
    assert problem == "killed after 0.5 s"
    pid = int((tmp_path / "pid").read_text())
    until_s = time.monotonic() + TIMEOUT_S
    while is_running(pid):
        assert time.monotonic() < until_s
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    """Whether a process exists that has not been killed."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
