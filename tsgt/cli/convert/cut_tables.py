"""Tables that may have been cut while they were written or copied."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


def note_cut_tables(paths: Iterable[Path]) -> None:
    """Print a note for each text file whose last line has no end: the start of a number is a number, too."""
    for path in filter(os.path.isfile, paths):  # A pipe cannot be read twice
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 1))
            if file.read(1) not in b"\r\n":  # which also contains the nothing of an empty file
                click.echo(
                    f"note: {path}: the last line has no line end; if the file was cut, its last number may be incomplete",
                    err=True,
                )
