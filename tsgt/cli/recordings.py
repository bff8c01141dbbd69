"""Writing results from the command line, and telling of what could not be read in them."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import click

import tsgt
from tsgt.clock import SystemClock
from tsgt.recording import RecordingHeader, encode_line, write_atomically

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from tsgt.errors import RecordingError
    from tsgt.model import Parameters


def write_recording(path: Path, *, source: str, parameters: Parameters, records: Iterable[object]) -> None:
    """Write a whole recording, or nothing: header, parameters, records in the order given."""
    header = RecordingHeader(
        software=f"tsgt {tsgt.__version__}", created_ns=SystemClock().realtime_ns(), source=source
    )
    with write_atomically(path) as file:
        for record in itertools.chain([header, parameters], records):
            file.write(encode_line(record) + b"\n")


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write a text, or nothing."""
    with write_atomically(path) as file:
        file.writelines(line.encode() for line in lines)


def report_problem(problem: RecordingError) -> None:
    """Tell the user of a line that is skipped."""
    click.echo(f"warning: {problem}", err=True)


def refuse_to_replace(inputs: Iterable[Path | None], output: Path | None) -> None:
    """Refuse to write a result over a file that it is made from; a path that is None was not given."""
    for path in inputs:
        if path is not None and output is not None and output.resolve() == path.resolve():
            raise click.UsageError(f"the output would replace its own input {path}; choose another file")
