"""The command ``import odometry``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tsgt.cli.convert.cut_tables import note_cut_tables
from tsgt.cli.convert.imported_samples import write_samples
from tsgt.cli.options import RECORDING_SUFFIXES, FiniteRange, OutputFile, json_option, path_type
from tsgt.cli.output import print_json, refuse_overwrite

if TYPE_CHECKING:
    from pathlib import Path


@click.command("odometry")
@click.argument("files", type=path_type, nargs=-1, required=True)
@click.option(
    "--offset-ms",
    type=FiniteRange(min=-1e9, max=1e9),
    default=0.0,
    show_default=True,
    help="Added to all times: the master's clock less that of the computer that recorded the files.",
)
@click.option(
    "--output",
    type=OutputFile(*RECORDING_SUFFIXES),
    required=True,
    help="File of odometry to write (.jsonl), beside a recording; replaced if it exists.",
)
@json_option
def import_odometry(*, files: tuple[Path, ...], offset_ms: float, output: Path, as_json: bool) -> None:
    """Import wheel odometry that another program recorded.

    The columns of the CSV FILES are stamp_ns or time_s (Unix time of the end of a sample's interval), speed_mps (forwards, mean over
    the interval) and, optionally, yaw_rate_radps.
    """
    from tsgt.analysis.formats import read_wheel_files, wheel_records

    refuse_overwrite(files, output)
    samples = read_wheel_files(files)
    note_cut_tables(files)
    gaps = write_samples(output, "odometry", files, wheel_records(samples, round(offset_ms * 1e6)))
    duration_s = (samples[-1].stamp_ns - samples[0].stamp_ns) / 1e9
    if as_json:
        print_json({"samples": len(samples), "duration_s": duration_s, "gaps": gaps})
        return
    click.echo(f"{output}: {len(samples)} samples over {duration_s:.1f} s, {gaps} gaps")
