"""Writes imported samples of a device, of an IMU or wheel odometry, as a file beside a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

import tsgt
from tsgt.analysis.text_file import utf8_name
from tsgt.clock import SystemClock
from tsgt.recording import RecordingHeader, encode_line, write_atomically

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from tsgt.model import ImuSamples, OdometrySamples


def write_samples(
    output: Path, device: str, files: Iterable[Path], records: Iterable[ImuSamples | OdometrySamples]
) -> int:
    """Write the records made from ``files``; return the number of gaps between them.

    Raises UsageError where ``--offset-ms`` leads to impossible times.
    """
    header = RecordingHeader(
        software=f"tsgt {tsgt.__version__}",
        created_ns=SystemClock().realtime_ns(),
        source=f"import {device}: {' '.join(utf8_name(path.name) for path in files)}",
    )
    gaps, expected = 0, 0
    try:
        with write_atomically(output) as file:
            file.write(encode_line(header) + b"\n")
            for record in records:
                gaps += record.sequence > expected
                expected = record.sequence + len(record.stamp_ns)
                file.write(encode_line(record) + b"\n")
    except ValueError as error:
        raise click.UsageError(f"--offset-ms: {error}") from error
    return gaps
