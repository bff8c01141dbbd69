"""The command ``process``."""

from __future__ import annotations

import dataclasses
import sys
import time
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import click

from tsgt.analysis.formats import tum_lines, valid_rows
from tsgt.analysis.processing import process as process_recording
from tsgt.analysis.smoothing import smoothed
from tsgt.cli.options import finite, json_option, keep_going_option, path_type, recording_argument
from tsgt.cli.output import print_json
from tsgt.cli.recordings import (
    TUNING,
    duration_s,
    estimator_option,
    frames_option,
    load,
    motion_keys,
    motion_text,
    pose_counts,
    pose_summary,
    prisms_option,
    progress,
    refuse_to_replace,
    write_lines,
    write_recording,
)

if TYPE_CHECKING:
    from collections.abc import Iterable
    from contextlib import AbstractContextManager
    from pathlib import Path

    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.smoothing import Motion
    from tsgt.estimation import PoseBatch
    from tsgt.model import Parameters
    from tsgt.recording import PoseRecord, Recording


@click.command()
@recording_argument
@estimator_option
@click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(0.01, 1000.0),
    callback=finite,
    help="Poses per second.  [default: as recorded, 20]",
)
@frames_option
@prisms_option
@click.option(
    "--output",
    type=path_type,
    required=True,
    help="TUM trajectory if it ends in .tum, else JSON lines with all poses.",
)
@keep_going_option
@json_option
def process(
    *,
    recording: Path,
    estimator: Estimator | None,
    rate_hz: float | None,
    frames: Path | None,
    prisms: Path | None,
    output: Path,
    keep_going: bool,
    as_json: bool,
) -> None:
    """Compute the poses of RECORDING from all its measurements, in the order of time."""
    refuse_to_replace([recording, frames, prisms], output)
    began_s = time.perf_counter()
    loaded = load(
        recording, keep_going=keep_going, estimator=estimator, rate_hz=rate_hz, frames=frames, prisms=prisms
    )
    poses, parameters, motion = _processed(loaded, recording)
    if output.suffix == ".tum":
        write_lines(output, tum_lines(valid_rows(poses)))
    else:
        with _progress(poses.records(), len(poses), "writing poses") as records:
            write_recording(
                output, source=f"process: {recording.name}", parameters=parameters, records=records
            )
    result: dict[str, Any] = {
        "estimator": parameters.pipeline.estimator,
        **pose_counts(poses),
        "seconds": time.perf_counter() - began_s,
        "duration_s": duration_s(poses),
        "measurements": len(loaded.measurements),
        **({} if motion is None else motion_keys(motion)),
    }
    if as_json:
        print_json(result)
        return
    click.echo(f"{output}: {pose_summary(poses)} from {len(loaded.measurements)} measurements")
    if motion is not None:
        click.echo(motion_text(motion))


def _processed(loaded: Recording, path: Path) -> tuple[PoseBatch, Parameters, Motion | None]:
    """Poses, what they were computed with, and what was found out on the way."""
    parameters = loaded.parameters
    if parameters.pipeline.estimator == "linear":
        return process_recording(loaded, path=path), parameters, None
    with progress("fitting", first=TUNING) as on_progress:
        found = smoothed(loaded, path=path, on_progress=on_progress)
    pipeline = dataclasses.replace(
        parameters.pipeline, motion=found.motion.prior, noise_scale=found.motion.noise_scale
    )
    return found.poses, dataclasses.replace(parameters, pipeline=pipeline), found.motion


def _progress(
    records: Iterable[PoseRecord], length: int, label: str
) -> AbstractContextManager[Iterable[PoseRecord]]:
    if not sys.stderr.isatty():
        return nullcontext(records)
    return click.progressbar(records, length=length, label=label, file=sys.stderr)
