"""Orderly shutdown, systemd notifications, periodic sync to disk, and exclusive UNIX sockets."""

from __future__ import annotations

import asyncio
import fcntl
import os
import signal
import socket
import stat
import time
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, NoReturn, TypeVar

import structlog

from tsgt.clock import first_suspension
from tsgt.errors import ComputerSuspendedError, StreamError, TsgtError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterator
    from pathlib import Path

    from tsgt.clock import Clock

T = TypeVar("T")

SYNC_INTERVAL_S = 1.0  # interval of syncs to disk: the most that a power cut can lose

STATUS_INTERVAL_S = 1.0  # interval of the status reports to systemd

MAX_SOCKET_PATH_BYTES = 107  # capacity of sockaddr_un without the terminating zero: unix(7)

_BACKLOG = 100

_FOLDER_LOCK_TIMEOUT_S = 1.0
"""Another program that opens a socket in the same folder holds the lock for a millisecond."""

log = structlog.get_logger()


async def until_suspended(main: Coroutine[None, None, None]) -> ComputerSuspendedError:
    """Run a daemon until it notices that the computer was suspended; return for how long. Raises its other errors.

    It has a task of its own: an error of a task group takes the place of a cancellation at the same time, and a daemon that is stopped
    just then would go on.
    """
    task = asyncio.create_task(main)
    cancelled = False
    try:
        await asyncio.wait([task])
    except asyncio.CancelledError:
        cancelled = True
        task.cancel()
    found: BaseExceptionGroup[ComputerSuspendedError] | None = None
    try:
        await task
    except* ComputerSuspendedError as errors:
        found = errors
    if cancelled:
        raise asyncio.CancelledError
    assert found is not None  # noqa: S101 (a daemon runs for ever)
    return first_suspension(found)


def run(main: Callable[[], Awaitable[T]]) -> T:
    """Run a coroutine in a new event loop and return its result; SIGINT, SIGTERM and SIGHUP cancel it.

    A SIGHUP that the caller ignores, as nohup does, stays ignored.

    Raises
    ------
    TsgtError
        The first one in an exception group: a user needs its message, not the group's traceback.
    KeyboardInterrupt
        SIGINT cancelled it.
    SystemExit
        SIGTERM or SIGHUP cancelled it; the status is 0, as a requested stop is no failure.
    """
    terminated = False

    async def main_with_signals() -> T:
        loop = asyncio.get_running_loop()
        task = asyncio.current_task()

        def terminate() -> None:
            nonlocal terminated
            terminated = True
            if task is not None:
                task.cancel()

        loop.add_signal_handler(signal.SIGTERM, terminate)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
            loop.add_signal_handler(signal.SIGHUP, terminate)  # the terminal or the SSH connection is gone
        return await main()

    try:
        return asyncio.run(main_with_signals())  # handles SIGINT in the same way
    except asyncio.CancelledError:
        if not terminated:
            raise
        raise SystemExit(0) from None
    except ExceptionGroup as group:
        known, others = group.split(TsgtError)
        if known is None or others is not None:
            raise
        raise _first_error(known) from group


def _first_error(group: ExceptionGroup[TsgtError]) -> TsgtError:
    first = group.exceptions[0]
    return _first_error(first) if isinstance(first, ExceptionGroup) else first


async def sync_periodically(
    sync: Callable[[], None], clock: Clock, interval_s: float = SYNC_INTERVAL_S
) -> NoReturn:
    """Sync a recording to disk periodically, in a thread, because a slow SD card takes seconds.

    Logs a failing disk once, and its recovery. ``sync``: returns when all data is on the disk; raises
    :class:`~tsgt.errors.TsgtError` on failure. ``interval_s``: from the end of one sync to the start of the next.
    """
    failing = False
    while True:
        await clock.sleep_until(clock.monotonic_ns() + round(interval_s * 1e9))
        try:
            await asyncio.to_thread(sync)
        except TsgtError as error:
            if not failing:
                log.error("sync_failed", error=str(error))  # noqa: TRY400 (the message says it all)
            failing = True
        else:
            if failing:
                log.info("sync_recovered")
            failing = False


def sd_notify(*assignments: str, status: Callable[[], str] | None = None) -> None:
    """Notify systemd with assignments as in sd_notify(3), such as ``READY=1``; without effect outside of systemd.

    ``status``: returns the text of a further assignment, ``STATUS``.
    """
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if status is not None:
        assignments = (*assignments, f"STATUS={status()}")
    if address.startswith("@"):  # an abstract socket
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.setblocking(False)
            sender.sendto("\n".join(assignments).encode(), address)
    except OSError as error:
        log.warning("sd_notify_failed", error=str(error))


def watchdog_interval_s() -> float | None:
    """Return half the watchdog timeout that systemd has set for this process; None without one."""
    timeout_us = os.environ.get("WATCHDOG_USEC", "")
    pid = os.environ.get("WATCHDOG_PID")
    if not timeout_us.isdecimal() or (pid is not None and pid != str(os.getpid())):
        return None
    return int(timeout_us) / 2e6


async def notify_systemd(status: Callable[[], str], clock: Clock) -> NoReturn:
    """Notify systemd of readiness, then each second of the status line and of being alive, and at the end of stopping."""
    interval_s = min(STATUS_INTERVAL_S, watchdog_interval_s() or STATUS_INTERVAL_S)
    sd_notify("READY=1", status=status)
    try:
        while True:
            await clock.sleep_until(clock.monotonic_ns() + round(interval_s * 1e9))
            sd_notify("WATCHDOG=1", status=status)
    finally:
        sd_notify("STOPPING=1")


class UnixListener:
    """A listening UNIX socket that no other program serves.

    ``path``: a stale socket is replaced; the folder is created if missing. ``mode``: file permissions. Raises
    StreamError if another program serves the socket, or it cannot be created.
    """

    def __init__(self, path: Path, mode: int) -> None:
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with _locked(path.parent):
                self.socket = _bind(path, mode)
                self._inode = path.lstat().st_ino
                self.socket.listen(_BACKLOG)
        except StreamError:
            raise
        except OSError as error:
            raise StreamError(
                f"{path}: the socket cannot be created ({error.strerror}); choose another path"
            ) from error

    def remove(self) -> None:
        """Remove the file, unless another program has replaced it."""
        with suppress(OSError):  # it is gone, or its folder is
            if self._path.lstat().st_ino == self._inode:
                self._path.unlink()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder, so that no other program opens the same socket between our check and our bind."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        deadline_s = time.monotonic() + _FOLDER_LOCK_TIMEOUT_S
        while True:  # daemons that start together compete here
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() > deadline_s:
                    raise StreamError(
                        f"{folder}: another program has locked this folder; stop it or choose another folder"
                    ) from error
                time.sleep(0.005)
        yield
    finally:
        os.close(descriptor)


def _bind(path: Path, mode: int) -> socket.socket:
    if len(os.fsencode(path)) > MAX_SOCKET_PATH_BYTES:
        raise StreamError(
            f"{path}: the path of a socket has at most {MAX_SOCKET_PATH_BYTES} bytes; choose a shorter one"
        )
    _remove_stale(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # bind() creates the file with the mode of the socket less the umask: it is never more accessible than `mode`.
        os.fchmod(listener.fileno(), mode)
        listener.bind(os.fspath(path))
        path.chmod(mode)
    except BaseException:
        listener.close()
        raise
    return listener


def _remove_stale(path: Path) -> None:
    """Remove a socket that no program serves, and nothing else."""
    try:
        is_socket = stat.S_ISSOCK(path.lstat().st_mode)
    except FileNotFoundError:
        return
    if not is_socket:
        raise StreamError(f"{path}: is not a socket; remove it or choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:
            path.unlink()
            log.info("stale_socket_replaced", path=str(path))
            return
        except BlockingIOError:
            pass  # served, but its backlog is full
    raise StreamError(f"{path}: another program serves this socket; stop it or choose another path")
