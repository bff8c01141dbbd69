"""Daemons as processes, restarted when they end, as systemd does in the field."""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from pathlib import Path

RESTART_DELAY_S = 1.0
"""From the end of a process to its next start."""

STOP_TIMEOUT_S = 5.0
"""From SIGTERM to SIGKILL; a daemon should stop within one second."""

# Stdin is a pipe that closes when this process ends, even by SIGKILL; then the daemon stops itself.
_PROGRAM = """
import os, signal, threading
def stop_with_parent():
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)
threading.Thread(target=stop_with_parent, daemon=True).start()
from tsgt.cli.daemons import {entry_point} as main
main()
"""


@dataclass(slots=True)
class Process:
    """A daemon process that is kept running."""

    name: str
    entry_point: str  # function of :mod:`tsgt.cli.daemons` that the process runs
    arguments: tuple[str, ...]
    log_path: Path  # file for its stderr and stdout
    pid: int | None = field(default=None, init=False)  # None: not running
    starts: int = field(default=0, init=False)  # number of starts

    async def keep_running(self) -> NoReturn:
        """Start the process whenever it is not running; stop it when cancelled."""
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
                    start_new_session=True,  # Ctrl-C must not reach it: the demonstration stops the daemons in order
                )
            self.pid, self.starts = process.pid, self.starts + 1
            try:
                await process.wait()
            except asyncio.CancelledError:
                await _end(process)
                raise
            finally:
                self.pid = None
            await asyncio.sleep(RESTART_DELAY_S)


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
