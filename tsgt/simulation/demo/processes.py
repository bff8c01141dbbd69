"""Daemons as processes of their own, started again when they die, as systemd does it in the field."""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from pathlib import Path

RESTART_AFTER_S = 1.0
"""From the end of a process to its next start."""

STOP_TIMEOUT_S = 5.0
"""How long a process has to end after SIGTERM; it should take one second."""

# Stdin is a pipe that ends when we do, however that happens; nobody would stop the daemon after that.
_PROGRAM = """
import os, signal, threading
def outlived():
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)
threading.Thread(target=outlived, daemon=True).start()
from tsgt.cli.daemons import {entry_point} as main
main()
"""


@dataclass(slots=True)
class Process:
    """A daemon that is kept running.

    Attributes
    ----------
    name
        For people.
    entry_point
        Function of :mod:`tsgt.cli.daemons` that the process runs.
    arguments
        Its command line.
    log_path
        Gets what it writes to stderr and stdout.
    pid
        Of the process that runs now; None while none does.
    starts
        How often it has been started.
    """

    name: str
    entry_point: str
    arguments: tuple[str, ...]
    log_path: Path
    pid: int | None = field(default=None, init=False)
    starts: int = field(default=0, init=False)

    async def keep_running(self) -> NoReturn:
        """Start the process, again and again when it ends; on being cancelled end it and wait for it."""
        while True:
            with self.log_path.open("ab") as log_file:
                process = await asyncio.create_subprocess_exec(
                    sys.executable,
                    "-c",
                    _PROGRAM.format(entry_point=self.entry_point),
                    *self.arguments,
                    stdin=asyncio.subprocess.PIPE,
                    stdout=log_file,
                    stderr=log_file,
                    start_new_session=True,  # Ctrl-C is for the demonstration, which ends them in order
                )
            self.pid, self.starts = process.pid, self.starts + 1
            try:
                await process.wait()
            except asyncio.CancelledError:
                await _end(process)
                raise
            finally:
                self.pid = None
            await asyncio.sleep(RESTART_AFTER_S)


async def _end(process: asyncio.subprocess.Process) -> None:
    with suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(STOP_TIMEOUT_S):
            await process.wait()
    except TimeoutError:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()
