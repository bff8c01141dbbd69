"""What a long-running program owes the system: an orderly end, signs of life to systemd, data on the disk."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from typing import TYPE_CHECKING, NoReturn, TypeVar

import structlog

from tsgt.errors import TsgtError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from tsgt.clock import Clock

T = TypeVar("T")

SYNC_INTERVAL_S = 1.0
"""How often a recording is brought to the disk: the most that a power cut can take."""

log = structlog.get_logger()


def run(main: Callable[[], Awaitable[T]]) -> T:
    """Run a coroutine to its end in an event loop of its own; SIGINT and SIGTERM cancel it.

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
        SIGTERM ended it, with status 0: a service that was told to stop has not failed.
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
