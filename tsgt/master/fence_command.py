"""Runs the command that a geo-fence is configured with."""

from __future__ import annotations

import asyncio
import os
import signal
from contextlib import suppress
from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from collections.abc import Sequence

TIMEOUT_S = 10.0
"""How long it may take before it is killed, with what it has started."""

KILL_TIMEOUT_S = 0.5
"""How long is waited for it to be gone then: one that may not be killed must not keep the master from ending."""

log = structlog.get_logger()


async def run_fence_command(command: Sequence[str], *, event: str, fence: str) -> None:
    """Run a command at a crossing; what becomes of it is told in the log, and nowhere else.

    Parameters
    ----------
    command
        Program and arguments.
    event, fence
        Put into its environment as ``TSGT_EVENT`` and ``TSGT_FENCE``.
    """
    problem = await _problem(command, os.environ | {"TSGT_EVENT": event, "TSGT_FENCE": fence})
    if problem:
        log.error("fence_command_failed", fence=fence, command=command[0], error=problem)
    else:
        log.info("fence_command_done", fence=fence, command=command[0])


async def _problem(command: Sequence[str], environment: dict[str, str]) -> str:
    """Run it; say what went wrong, or nothing."""
    environment.pop("NOTIFY_SOCKET", None)  # it is not a part of the service, and must not speak for it
    try:
        process = await asyncio.create_subprocess_exec(
            *command,
            env=environment,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            start_new_session=True,
        )
    except (OSError, ValueError) as error:  # ValueError: a zero byte among the arguments
        return f"cannot be started ({error})"
    try:
        async with asyncio.timeout(TIMEOUT_S):
            status = await process.wait()
    except TimeoutError:
        return f"killed after {TIMEOUT_S:g} s"
    else:
        return f"exit status {status}" if status else ""
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError, PermissionError):  # it may have become another user's
                os.killpg(process.pid, signal.SIGKILL)
            with suppress(TimeoutError):
                async with asyncio.timeout(KILL_TIMEOUT_S):
                    await process.wait()
