"""What a long-running program owes the system.

An orderly end, signs of life to systemd, data on the disk, and sockets that belong to one program at a time.
"""

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

from tsgt.errors import StreamError, TsgtError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from pathlib import Path

    from tsgt.clock import Clock

T = TypeVar("T")

SYNC_INTERVAL_S = 1.0
"""How often a recording is brought to the disk: the most that a power cut can take."""

STATUS_INTERVAL_S = 1.0
"""How often systemd is told how the service does."""

MAX_SOCKET_PATH_BYTES = 107
"""What sockaddr_un holds, less the end of the string: unix(7)."""

_BACKLOG = 100

_FOLDER_LOCK_LIMIT_S = 1.0
"""How long to wait for another program that opens a socket in the same folder; it takes a millisecond."""

log = structlog.get_logger()


def run(main: Callable[[], Awaitable[T]]) -> T:
    """Run a coroutine to its end in an event loop of its own; SIGINT, SIGTERM and SIGHUP cancel it.

    Parameters
    ----------
    main
        Makes the coroutine. What it holds open belongs into ``async with`` or ``finally``.

    Returns
    -------
    T
        What the coroutine returned, also when it did so on being cancelled.

    Raises
    ------
    TsgtError
        The first one that ended a task group of the coroutine; a user wants its line, not the group's tree.
    KeyboardInterrupt
        SIGINT ended it.
    SystemExit
        SIGTERM or SIGHUP ended it, with status 0: a service that was told to stop has not failed.
    """
    terminated = False

    async def cancelled_by_sigterm() -> T:
        loop = asyncio.get_running_loop()
        task = asyncio.current_task()

        def terminate() -> None:
            nonlocal terminated
            terminated = True
            if task is not None:
                task.cancel()

        loop.add_signal_handler(signal.SIGTERM, terminate)
        loop.add_signal_handler(
            signal.SIGHUP, terminate
        )  # the terminal, or the connection to this Pi, is gone
        return await main()

    try:
        return asyncio.run(cancelled_by_sigterm())  # which treats SIGINT in the same way
    except asyncio.CancelledError:
        if not terminated:
            raise
        raise SystemExit(0) from None
    except ExceptionGroup as group:
        known, others = group.split(TsgtError)
        if known is None or others is not None:
            raise
        raise _first(known) from group


def _first(group: ExceptionGroup[TsgtError]) -> TsgtError:
    first = group.exceptions[0]
    return _first(first) if isinstance(first, ExceptionGroup) else first


async def keep_synced(
    sync: Callable[[], None], clock: Clock, interval_s: float = SYNC_INTERVAL_S
) -> NoReturn:
    """Bring a recording to the disk again and again, in a thread, because a slow SD card takes seconds.

    A disk that fails is logged once, and once more when it is well again.

    Parameters
    ----------
    sync
        Returns when everything is on the disk; raises a :class:`~tsgt.errors.TsgtError` when it cannot.
    clock
        Sets the pace.
    interval_s
        From the end of one sync to the start of the next, in s.
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


def sd_notify(*assignments: str) -> None:
    """Tell systemd how the service does; does nothing where nobody asked for it.

    Parameters
    ----------
    assignments
        As in sd_notify(3): ``READY=1``, ``STATUS=...``, ``WATCHDOG=1``, ``STOPPING=1``.
    """
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):  # systemd's way of writing an abstract socket
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.setblocking(False)
            sender.sendto("\n".join(assignments).encode(), address)
    except OSError as error:
        log.warning("sd_notify_failed", error=str(error))


def watchdog_interval_s() -> float | None:
    """How often systemd wants ``WATCHDOG=1`` from this process, in s, with half the time in hand; None for never."""
    timeout_us = os.environ.get("WATCHDOG_USEC", "")
    pid = os.environ.get("WATCHDOG_PID")
    if not timeout_us.isdecimal() or (pid is not None and pid != str(os.getpid())):
        return None
    return int(timeout_us) / 2e6


async def keep_notified(status: Callable[[], str], clock: Clock) -> NoReturn:
    """Tell systemd that the service is ready, then how it does and that it lives, and at the end that it stops.

    Parameters
    ----------
    status
        One line for people, asked for each second.
    clock
        Sets the pace.
    """
    interval_s = min(STATUS_INTERVAL_S, watchdog_interval_s() or STATUS_INTERVAL_S)
    sd_notify("READY=1", f"STATUS={status()}")
    try:
        while True:
            await clock.sleep_until(clock.monotonic_ns() + round(interval_s * 1e9))
            sd_notify("WATCHDOG=1", f"STATUS={status()}")
    finally:
        sd_notify("STOPPING=1")


class UnixListener:
    """A UNIX socket that listens, and that no other program listens on.

    Parameters
    ----------
    path
        Where. A stale socket of an earlier run is replaced; the folder is created if need be.
    mode
        Its permissions.

    Attributes
    ----------
    socket
        To be given to an event loop.

    Raises
    ------
    StreamError
        Another program serves the socket, or it cannot be made.
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
                f"{path}: the socket cannot be made ({error.strerror}); choose another path"
            ) from error

    def remove(self) -> None:
        """Remove the file, unless another program has put its own there."""
        with suppress(OSError):  # it is gone, or its folder is: then there is nothing of ours to remove
            if self._path.lstat().st_ino == self._inode:
                self._path.unlink()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep another program from opening the same socket between our look at it and our listening."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        deadline_s = time.monotonic() + _FOLDER_LOCK_LIMIT_S
        while True:  # daemons that start together meet here
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
        # bind() gives the file the mode of the socket less the umask: it is never open to more than `mode` says.
        os.fchmod(listener.fileno(), mode)
        listener.bind(os.fspath(path))
        path.chmod(mode)
    except BaseException:
        listener.close()
        raise
    return listener


def _remove_stale(path: Path) -> None:
    """Remove a socket that nobody answers; leave everything else alone."""
    try:
        is_socket = stat.S_ISSOCK(path.lstat().st_mode)
    except FileNotFoundError:
        return
    if not is_socket:
        raise StreamError(f"{path}: is not a socket and is left alone; remove it or choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:
            path.unlink()
            log.info("stale_socket_replaced", path=str(path))
            return
        except BlockingIOError:
            pass  # so many wait there that it does not answer, but it is there
    raise StreamError(f"{path}: another program serves this socket; stop it or choose another path")
