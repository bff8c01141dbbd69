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
    """A clock whose sleepers wait for the test."""

    def __init__(self) -> None:
        self.wanted_ns: list[int] = []
        self._asleep = asyncio.Event()
        self._step = asyncio.Event()

    def monotonic_ns(self) -> int:
        """Return a constant."""
        return 5_000_000_000

    def realtime_ns(self) -> int:
        """Return a constant."""
        return 0

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Sleep until the next step."""
        self.wanted_ns.append(monotonic_ns)
        self._asleep.set()
        await self._step.wait()
        self._step.clear()

    async def step(self) -> None:
        """Release the sleeper and wait until it sleeps again."""
        self._asleep.clear()
        self._step.set()
        await self._asleep.wait()


async def synced(sync: Callable[[], None], steps: int) -> StepClock:
    """Sync for a number of intervals."""
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
    """An interval after the end of the last one."""
    calls: list[str] = []
    clock = await synced(lambda: calls.append(threading.current_thread().name), steps=3)
    assert len(calls) == 3
    assert clock.wanted_ns == [6_000_000_000] * 4


async def test_sync_does_not_block_the_loop() -> None:
    """It runs in a thread."""
    threads: list[threading.Thread] = []
    await synced(lambda: threads.append(threading.current_thread()), steps=1)
    assert threads[0] is not threading.main_thread()


async def test_failing_disk_is_logged_once() -> None:
    """And its recovery; syncing continues in between."""
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
    """One datagram, one assignment per line, on a socket with a path or an abstract one."""
    name = f"@tsgt-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", name)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(name.replace("@", "\0"))
        sd_notify("READY=1", "STATUS=3 stations")
        assert systemd.recv(1000) == b"READY=1\nSTATUS=3 stations"


def test_notification_without_systemd_has_no_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is logged."""
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    with capture_logs() as logs:
        sd_notify("READY=1")
    assert logs == []


def test_status_is_composed_for_systemd_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without systemd nobody reads it."""
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)

    def status() -> str:
        pytest.fail("composed")

    sd_notify("WATCHDOG=1", status=status)


def test_failing_notification_is_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The service continues."""
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
    """Half the timeout of systemd, if it is set for this process."""
    for name, value in (
        ("WATCHDOG_USEC", usec),
        ("WATCHDOG_PID", str(os.getpid()) if pid == "self" else pid),
    ):
        if value is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, value)
    assert watchdog_interval_s() == interval_s


async def test_systemd_is_notified_of_ready_alive_and_stopping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alive as often as the watchdog requires."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "1000000")
        clock = StepClock()
        notifying = asyncio.create_task(notify_systemd(lambda: "well", clock))
        await asyncio.sleep(0)
        await clock.step()
        notifying.cancel()
        await asyncio.wait([notifying])
        messages = [systemd.recv(100) for _ in range(3)]
    assert messages == [b"READY=1\nSTATUS=well", b"WATCHDOG=1\nSTATUS=well", b"STOPPING=1"]
    assert clock.wanted_ns == [5_500_000_000, 5_500_000_000]


def test_known_error_is_unwrapped_from_task_group() -> None:
    """The user gets its message, not a tree of exceptions."""

    async def fail() -> None:
        raise StreamError("nobody there")

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(fail())

    with pytest.raises(StreamError, match="nobody there"):
        run(main)


def test_unknown_error_keeps_its_group() -> None:
    """A bug is shown with its full traceback."""

    async def fail() -> None:
        raise ZeroDivisionError

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(fail())

    with pytest.raises(ExceptionGroup):
        run(main)


def test_locked_folder_is_awaited(tmp_path: Path) -> None:
    """Programs that start together open their sockets one after the other."""
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    other = threading.Timer(0.05, os.close, (descriptor,))
    other.start()
    listener = UnixListener(tmp_path / "a.sock", 0o600)
    other.join()
    listener.socket.close()
    assert (tmp_path / "a.sock").exists()
