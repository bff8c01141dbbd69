"""Progress of long computations on stderr, only if that is a terminal."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from tsgt.recording import PoseRecord

TUNING = "tuning the motion prior"
"""The phase before the first share of a fit is known: the number of its steps is not known in advance."""


@contextmanager
def progress(label: str, *, first: str | None = None) -> Iterator[Callable[[float], None] | None]:
    """Show a progress bar; yield a function that takes the share done, 0 to 1, or None without a terminal.

    Parameters
    ----------
    label
        What is being done.
    first
        What is being done until the first share is reported, if that differs.
    """
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(file=sys.stderr)) as bars:
        task = bars.add_task(first or label, total=1.0)
        yield lambda share: bars.update(task, completed=share, description=label)


def counted(
    records: Iterable[PoseRecord], length: int, on_progress: Callable[[float], None] | None
) -> Iterator[PoseRecord]:
    """Yield records and report the share of them that is done."""
    for number, record in enumerate(records, start=1):
        yield record
        if on_progress is not None and (number % 1000 == 0 or number == length):
            on_progress(number / length)
