"""The command ``import imu``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tsgt.cli.convert.cut_tables import note_cut_tables
from tsgt.cli.convert.imported_samples import write_samples
from tsgt.cli.options import RECORDING_SUFFIXES, FiniteRange, OutputFile, json_option, path_type
from tsgt.cli.output import print_json, refuse_overwrite

if TYPE_CHECKING:
    from pathlib import Path


@click.command("imu")
@click.argument("files", type=path_type, nargs=-1, required=True)
@click.option("--topic", help="Topic of sensor_msgs/Imu in a bag.  [default: the only one]")
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
    help="File of IMU samples to write (.jsonl), beside a recording; replaced if it exists.",
)
@json_option
def import_imu(
    *, files: tuple[Path, ...], topic: str | None, offset_ms: float, output: Path, as_json: bool
) -> None:
    """Import samples of the robot's IMU that another program recorded.

    FILES are CSV files, or ROS 2 bags (a folder, or an MCAP file) with sensor_msgs/Imu. The columns of a CSV file are
    stamp_ns or time_s (Unix time), angular_rate_x_radps, _y_, _z_, and specific_force_x_mps2, _y_, _z_, gravity
    included. Times must be those of the device, not of the arrival: durations are their differences.
    """
    from tsgt.analysis.formats import imu_records, interval_ns, read_imu_files
    from tsgt.analysis.formats.imu_files import TABLE_SUFFIX

    refuse_overwrite(files, output)
    samples = read_imu_files(files, topic)
    note_cut_tables(path for path in files if path.suffix == TABLE_SUFFIX)
    gaps = write_samples(output, "imu", files, imu_records(samples, round(offset_ms * 1e6)))
    rate_hz = 1e9 / interval_ns(samples)
    if as_json:
        print_json({"samples": len(samples), "rate_hz": rate_hz, "gaps": gaps})
        return
    duration_s = (samples[-1].stamp_ns - samples[0].stamp_ns) / 1e9
    click.echo(f"{output}: {len(samples)} samples over {duration_s:.1f} s, {rate_hz:.1f} Hz, {gaps} gaps")
