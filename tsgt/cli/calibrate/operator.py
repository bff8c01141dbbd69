"""The operator at the terminal, or a script: questions to stderr, replies from stdin."""

from __future__ import annotations

import asyncio
import os
import threading
from contextlib import suppress
from typing import Protocol

import click

STDIN = 0


class Operator(Protocol):
    """Aims the instruments."""

    async def ask(self, question: str) -> str | None:
        """Return the stripped reply; None at the end of the input."""
        ...

    def say(self, text: str) -> None:
        """Show a line."""
        ...


class Terminal:
    """Reads lines from stdin, also from a pipe or a file, without blocking the event loop."""

    def __init__(self) -> None:
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()
        self._loop: asyncio.AbstractEventLoop | None = None

    async def ask(self, question: str) -> str | None:
        """See :meth:`Operator.ask`."""
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
            # A daemon thread: only then Ctrl-C ends the program while it waits for a line.
            threading.Thread(target=self._read, args=(self._loop,), name="stdin", daemon=True).start()
        click.echo(f"{question} > ", nl=False, err=True)
        line = await self._lines.get()
        if line is None:
            self._lines.put_nowait(None)
            click.echo("(end of input)", err=True)
        return line

    def say(self, text: str) -> None:
        """See :meth:`Operator.say`."""
        click.echo(text, err=True)

    def _read(self, loop: asyncio.AbstractEventLoop) -> None:
        """Pass lines to the event loop; runs in the thread."""
        rest = b""
        # The event loop may be closed before the input is.
        with suppress(RuntimeError):
            # Not through Python's buffers: a thread killed at exit while it holds their lock crashes the program.
            while data := os.read(STDIN, 4096):
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    loop.call_soon_threadsafe(self._lines.put_nowait, line.decode(errors="replace").strip())
            if rest:
                loop.call_soon_threadsafe(self._lines.put_nowait, rest.decode(errors="replace").strip())
            loop.call_soon_threadsafe(self._lines.put_nowait, None)
