"""The command ``process``."""

from __future__ import annotations

import dataclasses
import time
from typing import TYPE_CHECKING, Any

import click

from tsgt.analysis.formats import pose_csv, tum_lines, valid_rows
from tsgt.analysis.inertial_smoothing import imu_keys
from tsgt.analysis.processing import process as process_recording
from tsgt.analysis.refinement import refinement_keys, refinement_text
from tsgt.analysis.smoothing import smooth_poses
from tsgt.analysis.text_file import utf8_name
from tsgt.cli.desk.unused_options import refuse_unused_by_linear, refuse_unused_wheels
from tsgt.cli.options import (
    FiniteRange,
    json_option,
    keep_going_option,
    path_type,
    point_option,
    recording_argument,
    unknown_suffix,
)
from tsgt.cli.output import print_json, refuse_overwrite, require_folder
from tsgt.cli.progress import TUNING, counted, progress
from tsgt.cli.recordings import (
    duration_s,
    estimator_option,
    frames_option,
    imu_options,
    imu_text,
    load,
    motion_keys,
    motion_text,
    pose_counts,
    pose_summary,
    prisms_option,
    refine_option,
    write_lines,
    write_recording,
)
from tsgt.estimation import point_label, with_noise_scales

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.refinement import Refine
    from tsgt.analysis.smoothing import SmoothedPoses
    from tsgt.cli.recordings import ImuOptions
    from tsgt.estimation import PoseBatch
    from tsgt.model import Parameters, ReferencePoint
    from tsgt.recording import Recording

FORMATS = {".tum": "tum", ".jsonl": "jsonl", ".json": "jsonl", ".csv": "csv"}


@click.command()
@recording_argument
@estimator_option
@click.option(
    "--rate",
    "rate_hz",
    type=FiniteRange(0.01, 1000.0),
    help="Poses per second.  [default: as recorded, else 20]",
)
@frames_option
@prisms_option
@point_option()
@click.option(
    "--format",
    "format_name",
    type=click.Choice(["tum", "jsonl", "csv"]),
    help="TUM (valid poses), JSON lines (a recording with all poses) or CSV (all poses).  "
    "[default: from the suffix of --output]",
)
@click.option(
    "--output",
    type=path_type,
    required=True,
    help="File to write: .tum, .jsonl or .csv; replaced if it exists.",
)
@refine_option
@imu_options
@keep_going_option
@json_option
def process(
    *,
    recording: Path,
    estimator: Estimator | None,
    rate_hz: float | None,
    frames: Path | None,
    prisms: Path | None,
    point: ReferencePoint | str | None,
    format_name: str | None,
    output: Path,
    refine: Refine,
    imu: ImuOptions,
    keep_going: bool,
    as_json: bool,
) -> None:
    """Compute poses from a recording.

    Uses all measurements of RECORDING in the order of their timestamps, including those that arrived late or were
    merged. With samples of the robot's IMU the estimator continuous uses these, too, and the measurements of two stations, or
    of one, are enough.
    """
    format_name = format_name or FORMATS.get(output.suffix)
    if format_name is None:
        raise click.UsageError(f"{unknown_suffix(output, tuple(FORMATS))}; or give --format")
    refuse_overwrite([recording, frames, prisms, imu.samples, imu.setup, imu.odometry], output)
    require_folder(output)
    started_s = time.perf_counter()
    loaded = load(
        recording,
        keep_going=keep_going,
        estimator=estimator,
        rate_hz=rate_hz,
        frames=frames,
        prisms=prisms,
        point=point,
        imu=imu,
    )
    refuse_unused_by_linear(loaded, recording, imu, refine)
    refuse_unused_wheels(loaded, recording, imu)
    poses, parameters, continuous = _processed(loaded, recording, refine)
    with progress("writing poses") as on_progress:
        if format_name == "tum":
            write_lines(output, tum_lines(valid_rows(poses), poses.reference_point))
        else:
            records = counted(poses.records(), len(poses), on_progress)
            if format_name == "csv":
                write_lines(output, pose_csv(records))
            else:
                source = f"process: {utf8_name(recording.name)}"
                write_recording(output, source=source, parameters=parameters, records=records)
    if as_json:
        print_json(
            {
                "estimator": parameters.pipeline.estimator,
                "reference_point": dataclasses.asdict(poses.reference_point),
                **pose_counts(poses),
                "seconds": time.perf_counter() - started_s,
                "duration_s": duration_s(poses),
                "measurements": len(loaded.measurements),
                **({} if continuous is None else _continuous_keys(continuous)),
            }
        )
        return
    at = point_label(poses.reference_point)
    click.echo(f"{output}: {pose_summary(poses)} from {len(loaded.measurements)} measurements, at {at}")
    if continuous is not None:
        click.echo(refinement_text(continuous.refinement, continuous.parameters))
        used = imu_text(continuous)
        if used is not None:
            click.echo(used)
        click.echo(motion_text(continuous, loaded.parameters.pipeline.motion))
        if continuous.imu is None:
            click.echo(f"At rest: {continuous.rest_s:.1f} s in {len(continuous.rest)} intervals")


def _continuous_keys(continuous: SmoothedPoses) -> dict[str, Any]:
    """Return for ``--json`` what the poses of ``continuous`` were computed with."""
    return {
        **motion_keys(continuous),
        **imu_keys(continuous.imu, continuous.imu_problem),
        **refinement_keys(continuous.refinement, continuous.parameters),
        "rest_s": continuous.rest_s,
    }


def _processed(
    loaded: Recording, path: Path, refine: Refine
) -> tuple[PoseBatch, Parameters, SmoothedPoses | None]:
    """Return the poses, the parameters that they were computed with, and the trajectory of ``continuous``."""
    parameters = loaded.parameters
    if parameters.pipeline.estimator == "linear":
        return process_recording(loaded, path=path), parameters, None
    with progress("fitting", first=TUNING) as on_progress:
        found = smooth_poses(loaded, path=path, refine=refine, on_progress=on_progress)
    motion = found.motion
    pipeline = dataclasses.replace(parameters.pipeline, motion=motion.prior)
    parameters = dataclasses.replace(found.parameters, pipeline=pipeline)
    return found.poses, with_noise_scales(parameters, motion.noise_scales, motion.noise_scale), found
