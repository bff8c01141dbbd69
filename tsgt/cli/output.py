"""Results on stdout as text, tables or JSON, and checks of the files that results go to."""

from __future__ import annotations

import errno
import importlib
import json
import math
import os
import sys
from typing import TYPE_CHECKING, Any

import click

from tsgt.errors import MissingExtraError, OutputFileError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from tsgt.errors import RecordingError

CHECK_FAILED = 3

_TABLE_WIDTH = 10_000
"""More than any table needs, so that the layout does not depend on the terminal."""


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object; a number that is not finite becomes null."""
    click.echo(json_text(data))


def json_text(data: Mapping[str, Any]) -> str:
    """Return what :func:`print_json` prints."""
    return json.dumps(_finite(data), indent=2, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, the first column aligned left, the others right; plain text unless stdout is a terminal."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for index, title in enumerate(header):
        table.add_column(title, justify="right" if index else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console = Console(
        width=_TABLE_WIDTH,
        color_system="auto" if sys.stdout.isatty() else None,
        markup=False,
        highlight=False,
        emoji=False,
    )
    console.print(table)


def percent(share: float) -> str:
    """Return a share as text; "-" for NaN."""
    return f"{share:.2%}" if share == share else "-"


def numbers(*values: float, digits: int = 2) -> list[str]:
    """Return table cells; NaN becomes a dash."""
    return ["-" if math.isnan(value) else f"{value:.{digits}f}" for value in values]


def printable(text: str) -> str:
    """Return text from outside without characters that control a terminal."""
    return "".join(sign if sign.isprintable() else "?" for sign in text)


def report_problem(problem: RecordingError) -> None:
    """Print a warning about a skipped line."""
    click.echo(f"warning: {problem}", err=True)


def require_extra(purpose: str, *libraries: str, extra: str) -> None:
    """Check that an optional dependency is installed, before the work that needs it.

    Raises
    ------
    MissingExtraError
        A library cannot be imported.
    """
    for library in libraries:
        try:
            importlib.import_module(library)
        except ImportError as error:
            raise MissingExtraError(purpose, library=library.partition(".")[0], extra=extra) from error


def require_new_file(path: Path | None) -> None:
    """Reject an existing file and a missing folder before a long run."""
    if path is None:
        return
    if path.is_file():
        raise click.UsageError(f"{path} exists; choose another file")
    if not path.absolute().parent.is_dir():
        raise click.UsageError(f"{path}: no such folder")


def require_folder(path: Path | None) -> None:
    """Raise OutputFileError before a long run if a file to write has no folder, or one that cannot be written."""
    if path is None or (path.exists() and not path.is_file()):  # A pipe is written directly
        return
    folder = path.resolve().parent
    if not folder.is_dir():
        raise OutputFileError(f"cannot be written ({os.strerror(errno.ENOENT)})", path=path)
    if not os.access(folder, os.W_OK):
        raise OutputFileError(f"cannot be written ({os.strerror(errno.EACCES)})", path=path)


def refuse_overwrite(inputs: Iterable[Path | None], output: Path | None) -> None:
    """Reject an output that would replace one of its inputs."""
    for path in inputs:
        if path is not None and output is not None and output.resolve() == path.resolve():
            raise click.UsageError(f"the output would replace its own input {path}; choose another file")
