"""The command ``import imu``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from tsgt.cli.convert.cut_tables import note_cut_tables
from tsgt.cli.convert.imported_samples import write_samples
from tsgt.cli.options import RECORDING_SUFFIXES, FiniteRange, OutputFile, json_option, path_type
from tsgt.cli.output import print_json, refuse_overwrite, report_problem
from tsgt.cli.progress import progress
from tsgt.cli.recordings import calibrated
from tsgt.config import IMU_NOISE
from tsgt.recording import load_recording

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.calibration import AlignedClock
    from tsgt.analysis.formats.imu_files import FileSample

_NOISE = "consumer"  # Which class it is matters little to its clock


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
    "--align",
    "recording",
    type=path_type,
    metavar="RECORDING",
    help="Find offset and drift of the files' clock from the motion of the robot in this recording of three stations, and remove "
    "them with the latency of the stamps.",
)
@click.option(
    "--output",
    type=OutputFile(*RECORDING_SUFFIXES),
    required=True,
    help="File of IMU samples to write (.jsonl), beside a recording; replaced if it exists.",
)
@json_option
@click.pass_context
def import_imu(
    context: click.Context,
    *,
    files: tuple[Path, ...],
    topic: str | None,
    offset_ms: float,
    recording: Path | None,
    output: Path,
    as_json: bool,
) -> None:
    """Import samples of the robot's IMU that another program recorded.

    FILES are CSV files, or ROS 2 bags (a folder, or an MCAP file) with sensor_msgs/Imu. The columns of a CSV file are
    stamp_ns or time_s (Unix time), angular_rate_x_radps, _y_, _z_, and specific_force_x_mps2, _y_, _z_, gravity
    included. Times must be those of the device, not of the arrival: durations are their differences, and no two samples
    have the same time.
    """
    from tsgt.analysis.formats import imu_records, interval_ns, read_imu_files
    from tsgt.analysis.formats.bag import is_bag

    if recording is not None and context.get_parameter_source("offset_ms") is not ParameterSource.DEFAULT:
        raise click.UsageError("--align finds the offset; omit --offset-ms")
    refuse_overwrite([*files, recording], output)
    tables = [path for path in files if not is_bag(path)]
    if topic is not None and len(tables) == len(files):
        raise click.UsageError("--topic is of a bag, and no file is one")
    samples = read_imu_files(files, topic)
    note_cut_tables(tables)
    offset_ns = round(offset_ms * 1e6)
    clock = None if recording is None else _aligned(recording, samples)
    to_master_ns = (lambda stamp_ns: stamp_ns + offset_ns) if clock is None else clock.to_master_ns
    gaps = write_samples(output, "imu", files, imu_records(samples, to_master_ns))
    rate_hz = 1e9 / interval_ns(samples)
    if as_json:
        content = {"samples": len(samples), "rate_hz": rate_hz, "gaps": gaps}
        print_json(content if clock is None else content | {"clock": _json(clock)})
        return
    duration_s = (samples[-1].stamp_ns - samples[0].stamp_ns) / 1e9
    click.echo(f"{output}: {len(samples)} samples over {duration_s:.1f} s, {rate_hz:.1f} Hz, {gaps} gaps")
    if clock is not None:
        found = _json(clock)
        click.echo(
            "clock of the files less the master's, with the latency of the stamps: "
            "{offset_ms:.1f} ms (sigma {offset_sigma_ms:.1f}) and {drift_ppm:.1f} ppm ({drift_sigma_ppm:.1f}), "
            "from {parts} parts of the drive that differ by {rms_ms:.1f} ms (rms)".format(**found)
        )


def _aligned(recording: Path, samples: Sequence[FileSample]) -> AlignedClock:
    from tsgt.analysis.calibration import align_recorded_clock
    from tsgt.analysis.formats import imu_records

    loaded = calibrated(load_recording(recording, on_problem=report_problem), recording)
    with progress("aligning the clock") as on_progress:
        return align_recorded_clock(loaded, imu_records(samples), IMU_NOISE[_NOISE], on_progress=on_progress)


def _json(clock: AlignedClock) -> dict[str, float]:
    found = clock.alignment
    return {
        "offset_ms": 1e3 * found.offset_s,
        "offset_sigma_ms": 1e3 * found.offset_sigma_s,
        "drift_ppm": 1e6 * found.drift,
        "drift_sigma_ppm": 1e6 * found.drift_sigma,
        "parts": found.parts,
        "rms_ms": 1e3 * found.rms_s,
    }
