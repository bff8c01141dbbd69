"""Runs a command once, so that it can neither delay nor outlive its daemon."""

from __future__ import annotations

import asyncio
import os
import signal
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO

from tsgt.service.program_lines import printable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

COMMAND_TIMEOUT_S = 10.0  # after this a command is killed, with its child processes

KILL_TIMEOUT_S = 0.5
"""How long to wait for the end of a killed command: one that may not be killed must not block the daemon."""

_MAX_OUTPUT_CHARACTERS = 300


async def run_command(
    command: Sequence[str],
    environment: Mapping[str, str],
    *,
    stdin: bytes = b"",
    explains_failure: bool = False,
) -> str:
    """Run a command without a shell, in a session of its own; return what went wrong, or an empty string.

    ``environment`` is added to that of this process. ``explains_failure``: what it prints says why it failed; only for
    programs of tsgt, as it is kept in memory.
    """
    environment = os.environ | environment
    environment.pop("NOTIFY_SOCKET", None)  # only the service itself may notify systemd
    # Files in memory: unlike a pipe, they need nobody to feed or to drain them, and a full disk does not matter.
    with _file_in_memory() as given, _file_in_memory() as printed:
        given.write(stdin)
        given.seek(0)
        try:
            process = await asyncio.create_subprocess_exec(
                *command,
                env=environment,
                stdin=given,
                stdout=printed if explains_failure else asyncio.subprocess.DEVNULL,
                start_new_session=True,
            )
        except (OSError, ValueError) as error:  # ValueError: a zero byte in an argument
            return f"cannot be started ({error})"
        problem = await _end(process)
        printed.seek(0)
        reason = printed.read(4 * _MAX_OUTPUT_CHARACTERS).decode(errors="replace").strip()
    return printable(reason)[:_MAX_OUTPUT_CHARACTERS] if problem and reason else problem


def _file_in_memory() -> BinaryIO:
    return os.fdopen(os.memfd_create("tsgt"), "w+b")


async def _end(process: asyncio.subprocess.Process) -> str:
    """Wait for the end of a process, and kill it if that does not come; return what went wrong."""
    try:
        async with asyncio.timeout(COMMAND_TIMEOUT_S):
            status = await process.wait()
    except TimeoutError:
        return f"killed after {COMMAND_TIMEOUT_S:g} s"
    else:
        return f"exit status {status}" if status else ""
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError, PermissionError):  # it may run as another user
                os.killpg(process.pid, signal.SIGKILL)
            with suppress(TimeoutError):
                async with asyncio.timeout(KILL_TIMEOUT_S):
                    await process.wait()
