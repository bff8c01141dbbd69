"""Results on stdout, as text for people or as JSON for machines."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

CHECK_FAILED = 3


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object; a number that is not finite becomes null, as JSON has none."""
    click.echo(json_text(data))


def json_text(data: Mapping[str, Any]) -> str:
    """Return what :func:`print_json` prints."""
    return json.dumps(_finite(data), indent=2, allow_nan=False)


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print aligned columns, the first to the left and the others to the right."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    for row in (header, *rows):
        cells = [
            row[0].ljust(widths[0]),
            *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True)),
        ]
        click.echo("  ".join(cells).rstrip())


def harmless(text: str) -> str:
    """Return a line with text from outside as one that only writes to a terminal and does not steer it."""
    return "".join(sign if sign.isprintable() else "?" for sign in text)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def require_new_file(path: Path | None) -> None:
    """Refuse a file that exists, or whose folder does not: before a long run, not after it."""
    if path is None:
        return
    if path.is_file():
        raise click.UsageError(f"{path} exists; choose another file")
    if not path.absolute().parent.is_dir():
        raise click.UsageError(f"{path}: there is no such folder")
