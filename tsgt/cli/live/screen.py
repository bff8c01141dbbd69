"""A screen of blocks that is updated in place: as many beside each other as the terminal is wide, events below."""

from __future__ import annotations

import itertools
import signal
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from tsgt.cli.live.status_text import WIDTH
from tsgt.cli.output import printable

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tsgt.cli.live.status_text import Block

REFRESH_S = 0.25

MAX_GAP = 2  # characters between blocks; none on 80 columns


class Show(Protocol):
    """Shows headlines, blocks and events."""

    def __call__(self, headlines: Sequence[str], blocks: Sequence[Block], events: Sequence[str]) -> None:
        """Replace what is shown."""


@contextmanager
def screen() -> Iterator[Show]:
    """Take over the terminal; yield a function that shows headlines, blocks and events. Ctrl-C ends the block normally."""
    console = Console(highlight=False, markup=False, emoji=False)
    with (
        _stoppable(),
        Live(console=console, screen=True, auto_refresh=False, vertical_overflow="crop") as live,
    ):

        def show(headlines: Sequence[str], blocks: Sequence[Block], events: Sequence[str]) -> None:
            lines = layout(headlines, blocks, events, width=console.width, height=console.height)
            # Without wrapping: a line that is wider than the terminal would move all others.
            texts = [Text.from_ansi(line, no_wrap=True, overflow="crop", end="") for line in lines]
            live.update(Group(*(text.append("\n") for text in texts[:-1]), *texts[-1:]), refresh=True)

        yield show


@contextmanager
def _stoppable() -> Iterator[None]:
    """End on Ctrl-C and SIGTERM, with the terminal as it was."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)


def layout(
    headlines: Sequence[str], blocks: Sequence[Block], events: Sequence[str], *, width: int, height: int
) -> list[str]:
    """Return the lines of a screen; events, the newest last, get the space that the blocks leave.

    Lines may be styled by escape sequences; they are as wide as they are printed.
    """
    per_row = max(1, width // WIDTH)
    column = min(width // per_row, WIDTH + MAX_GAP)
    lines = list(headlines)
    for first in range(0, len(blocks), per_row):
        lines.append("")
        lines += (
            "".join(_padded(line, column) for line in beside).rstrip()
            for beside in itertools.zip_longest(*blocks[first : first + per_row], fillvalue="")
        )
    space = height - len(lines) - 1
    if events and space > 0:
        lines += ["", *(_cropped(event, width) for event in events[-space:])]
    return lines[:height]


def _padded(line: str, width: int) -> str:
    return line + " " * max(0, width - Text.from_ansi(line).cell_len)


def _cropped(text: str, width: int) -> str:
    return printable(text)[:width]
