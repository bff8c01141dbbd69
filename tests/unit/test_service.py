from __future__ import annotations

import asyncio
import fcntl
import os
import socket
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from structlog.testing import capture_logs

from tsgt.errors import RecordingError, StreamError
from tsgt.service import (
    UnixListener,
    notify_systemd,
    run,
    sd_notify,
    sync_periodically,
    watchdog_interval_s,
)

if TYPE_CHECKING:
    from collections.abc import Callable


class StepClock:
    """A clock whose sleepers go on when the test says so."""

    def __init__(self) -> None:
        self.wanted_ns: list[int] = []
        self._asleep = asyncio.Event()
        self._step = asyncio.Event()

    def monotonic_ns(self) -> int:
        """Stand still."""
        return 5_000_000_000

    def realtime_ns(self) -> int:
        """Stand still."""
        return 0

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Sleep until the next step."""
        self.wanted_ns.append(monotonic_ns)
        self._asleep.set()
        await self._step.wait()
        self._step.clear()

    async def step(self) -> None:
        """Let the sleeper go and wait until it sleeps again."""
        self._asleep.clear()
        self._step.set()
        await self._asleep.wait()


async def synced(sync: Callable[[], None], steps: int) -> StepClock:
    """Keep something synced for so many intervals."""
    clock = StepClock()
    task = asyncio.create_task(sync_periodically(sync, clock, interval_s=1.0))
    await asyncio.sleep(0)
    for _ in range(steps):
        await clock.step()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    return clock


async def test_sync_is_called_every_interval() -> None:
    """The recording is brought to the disk once per interval, an interval from now."""
    calls: list[str] = []
    clock = await synced(lambda: calls.append(threading.current_thread().name), steps=3)
    assert len(calls) == 3
    assert clock.wanted_ns == [6_000_000_000] * 4


async def test_sync_does_not_block_the_loop() -> None:
    """A disk that takes its time is waited for in a thread."""
    threads: list[threading.Thread] = []
    await synced(lambda: threads.append(threading.current_thread()), steps=1)
    assert threads[0] is not threading.main_thread()


async def test_failing_disk_is_logged_once() -> None:
    """Trouble and its end are logged when they begin, and keeping goes on in between."""
    outcomes = iter([True, False, False, True])

    def sync() -> None:
        if not next(outcomes):
            raise RecordingError("broken", path=Path("r.jsonl"))

    with capture_logs() as logs:
        await synced(sync, steps=4)
    assert [entry["event"] for entry in logs] == ["sync_failed", "sync_recovered"]
    assert logs[0]["error"] == "r.jsonl: broken"


@pytest.mark.parametrize("abstract", [False, True])
def test_notification_reaches_systemd(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, abstract: bool
) -> None:
    """Assignments arrive in one datagram, one per line, on a socket with a path or an abstract one."""
    name = f"@tsgt-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", name)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(name.replace("@", "\0"))
        sd_notify("READY=1", "STATUS=3 stations")
        assert systemd.recv(1000) == b"READY=1\nSTATUS=3 stations"


def test_notification_without_systemd_is_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Outside of systemd nothing happens."""
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    with capture_logs() as logs:
        sd_notify("READY=1")
    assert logs == []


def test_notification_that_fails_is_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A socket that is not there does not end the service."""
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    with capture_logs() as logs:
        sd_notify("READY=1")
    assert [entry["event"] for entry in logs] == ["sd_notify_failed"]


@pytest.mark.parametrize(
    ("usec", "pid", "interval_s"),
    [
        ("30000000", None, 15.0),
        ("30000000", "self", 15.0),
        ("30000000", "1", None),
        (None, None, None),
        ("soon", None, None),
    ],
)
def test_watchdog_interval(
    monkeypatch: pytest.MonkeyPatch, usec: str | None, pid: str | None, interval_s: float | None
) -> None:
    """The interval is half of what systemd allows, if it is meant for this process."""
    for name, value in (
        ("WATCHDOG_USEC", usec),
        ("WATCHDOG_PID", str(os.getpid()) if pid == "self" else pid),
    ):
        if value is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, value)
    assert watchdog_interval_s() == interval_s


async def test_systemd_hears_ready_alive_and_stopping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ready at once, alive as often as systemd asks, and at the end that it stops."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "1000000")
        clock = StepClock()
        telling = asyncio.create_task(notify_systemd(lambda: "well", clock))
        await asyncio.sleep(0)
        await clock.step()
        telling.cancel()
        await asyncio.wait([telling])
        messages = [systemd.recv(100) for _ in range(3)]
    assert messages == [b"READY=1\nSTATUS=well", b"WATCHDOG=1\nSTATUS=well", b"STOPPING=1"]
    assert clock.wanted_ns == [5_500_000_000, 5_500_000_000]


def test_a_known_error_comes_out_of_a_task_group_as_itself() -> None:
    """The user gets the error's one line, not a tree of exceptions."""

    async def fail() -> None:
        raise StreamError("nobody there")

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(fail())

    with pytest.raises(StreamError, match="nobody there"):
        run(main)


def test_an_unknown_error_keeps_its_tree() -> None:
    """A bug is shown with everything that there is to know about it."""

    async def fail() -> None:
        raise ZeroDivisionError

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(fail())

    with pytest.raises(ExceptionGroup):
        run(main)


def test_programs_that_open_sockets_together_wait_for_each_other(tmp_path: Path) -> None:
    """One that finds the folder locked for a moment opens its socket after that."""
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    other = threading.Timer(0.05, os.close, (descriptor,))
    other.start()
    listener = UnixListener(tmp_path / "a.sock", 0o600)
    other.join()
    listener.socket.close()
    assert (tmp_path / "a.sock").exists()
