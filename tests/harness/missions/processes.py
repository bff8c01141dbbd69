"""Programs that tests start: a program that ends is noticed at once and shows its log; deadlines only guard against hanging."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

T = TypeVar("T")

ROOT = Path(__file__).parents[3]

TIMEOUT_S = 60.0
"""How long a busy machine may take for what takes a few seconds."""

_POLL_S = 0.02
_FREE_PORTS = range(20_000, 32_000)  # below those that the system gives to outgoing connections


def wait_for(
    condition: Callable[[], T],
    *programs: subprocess.Popen[bytes] | subprocess.Popen[str],
    shows: Path | str = "",
) -> T:
    """Return the first true value of a condition.

    Raises AssertionError with the text or file ``shows`` when a program has ended before, or after :data:`TIMEOUT_S`.
    """
    deadline_s = time.monotonic() + TIMEOUT_S
    while True:
        ended = [program.returncode for program in programs if program.poll() is not None]
        late = time.monotonic() > deadline_s
        if found := condition():
            return found
        if ended or late:
            why = f"ended with {ended[0]}" if ended else f"nothing within {TIMEOUT_S:.0f} s"
            log = shows.read_text(errors="replace") if isinstance(shows, Path) else shows
            raise AssertionError(f"{why}:\n{log}")
        time.sleep(_POLL_S)


def free_port(address: str = "127.0.0.1") -> int:
    """Return a port that a server can listen at; give the very address at which it will."""
    while True:
        port = random.SystemRandom().choice(_FREE_PORTS)
        with suppress(OSError), socket.create_server((address, port)):
            return port


class Program:
    """A program whose output goes to FOLDER/NAME.out and its log to FOLDER/NAME.err; stopped at the end of the block.

    ``leads``: it has children, which are stopped with it.
    """

    def __init__(
        self,
        command: Sequence[str | Path],
        folder: Path,
        name: str,
        *,
        leads: bool = False,
        **environment: str,
    ) -> None:
        self.output, self.log = folder / f"{name}.out", folder / f"{name}.err"
        self._leads = leads
        with self.output.open("wb") as output, self.log.open("wb") as log:
            self.process = subprocess.Popen(
                command,
                stdout=output,
                stderr=log,
                cwd=ROOT,
                env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", **environment},
                start_new_session=leads,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for number in (signal.SIGTERM, signal.SIGKILL):
            with suppress(ProcessLookupError):
                if self._leads:
                    os.killpg(self.process.pid, number)
                else:
                    self.process.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(5)

    def wait_for(self, text: str) -> None:
        """Wait until the log has a text."""
        wait_for(lambda: text in self.log.read_text(errors="replace"), self.process, shows=self.log)

    def wait_for_lines(self, count: int) -> None:
        """Wait until the output has so many lines."""
        wait_for(lambda: self.lines() >= count, self.process, shows=self.log)

    def lines(self) -> int:
        """Return the number of lines of the output so far."""
        return self.output.read_bytes().count(b"\n")

    def ended(self) -> int:
        """Wait until the program has ended by itself; return its exit code."""
        return self.process.wait(TIMEOUT_S)
