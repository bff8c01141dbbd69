"""Commands of the desk: ``process``, ``evaluate`` and ``export``."""

from __future__ import annotations

import dataclasses
import itertools
import math
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.export import measurement_csv, pose_csv, tum_lines, valid_records, valid_rows
from tsgt.analysis.inter_prism import inter_prism
from tsgt.analysis.processing import has_raw_angles, with_frames, with_layout
from tsgt.analysis.processing import process as process_recording
from tsgt.cli.options import finite, json_option, keep_going_option, path_type, recording_argument
from tsgt.cli.output import print_json, print_table
from tsgt.cli.recordings import refuse_to_replace, report_problem, write_recording
from tsgt.config import load_prism_layout, load_station_frames
from tsgt.errors import CorruptLineError
from tsgt.master.stream_records import PoseRecord
from tsgt.master.tracks import build_tracks
from tsgt.recording import (
    decode_line,
    load_recording,
    read_lines,
    write_atomically,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from contextlib import AbstractContextManager

    from tsgt.analysis.inter_prism import PairDistances
    from tsgt.master.pose_batch import PoseBatch
    from tsgt.recording import Recording

STDOUT = Path("-")

estimator_option = click.option(
    "--estimator",
    type=click.Choice(["linear"]),
    default="linear",
    show_default=True,
    help="Name of the estimator.",
)
frames_option = click.option(
    "--frames", type=path_type, help="Station frames (set-up file) instead of those in the recording."
)
prisms_option = click.option(
    "--prisms", type=path_type, help="Prism layout (set-up file) instead of that in the recording."
)


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
    estimator: str,  # noqa: ARG001 (there is one so far, and it is the recording's)
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
    loaded = _load(recording, keep_going=keep_going, rate_hz=rate_hz, frames=frames, prisms=prisms)
    poses = process_recording(loaded, path=recording)
    if output.suffix == ".tum":
        _write_text(output, tum_lines(valid_rows(poses)))
    else:
        with _progress(poses.records(), len(poses), "writing poses") as records:
            write_recording(
                output, source=f"process: {recording.name}", parameters=loaded.parameters, records=records
            )
    result = {
        **_pose_counts(poses),
        "seconds": time.perf_counter() - began_s,
        "duration_s": _duration_s(poses),
        "measurements": len(loaded.measurements),
    }
    if as_json:
        print_json(result)
        return
    click.echo(f"{output}: {_pose_summary(poses)} from {len(loaded.measurements)} measurements")


@click.command()
@recording_argument
@estimator_option
@frames_option
@prisms_option
@keep_going_option
@json_option
def evaluate(
    *,
    recording: Path,
    estimator: str,
    frames: Path | None,
    prisms: Path | None,
    keep_going: bool,
    as_json: bool,
) -> None:
    """Judge RECORDING by the distances between its prisms, which the robot cannot change."""
    loaded = _load(recording, keep_going=keep_going, frames=frames, prisms=prisms)
    poses = process_recording(loaded, path=recording)
    found = inter_prism(loaded.parameters, build_tracks(loaded.parameters, loaded.measurements))
    if as_json:
        print_json(
            {
                "estimator": estimator,
                "duration_s": _duration_s(poses),
                **_pose_counts(poses),
                "epochs": found.epochs,
                "invalid_epochs": found.invalid_epochs,
                "inter_prism_mm": _figures(found.dynamic),
                "still_s": found.still_s,
                "inter_prism_static_mm": _figures(found.static),
            }
        )
        return
    click.echo(f"{_pose_summary(poses)} over {_duration_s(poses):.1f} s")
    valid = found.epochs - found.invalid_epochs
    click.echo(
        f"\nDistances between prisms at 20 Hz, interpolated: {valid} of {found.epochs} epochs valid (mm)"
    )
    _print_pairs(found.dynamic)
    click.echo(f"\nDistances between prisms standing still, raw pairs within {found.still_s:.1f} s (mm)")
    _print_pairs(found.static)


@click.command()
@recording_argument
@click.option(
    "--format", "format_name", type=click.Choice(["tum", "csv"]), required=True, help="Format to write."
)
@click.option(
    "--records",
    type=click.Choice(["poses", "measurements"]),
    default="poses",
    show_default=True,
    help="What to write; TUM holds poses only.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path, allow_dash=True),
    default=STDOUT,
    help="File to write.  [default: stdout]",
)
@keep_going_option
def export(
    *,
    recording: Path,
    format_name: str,
    records: str,
    output: Path,
    keep_going: bool,
) -> None:
    """Write the poses or measurements of RECORDING for other programs.

    Poses are those that stand in the recording as they were streamed or processed; a recording without any is
    processed first. TUM gets the valid poses, CSV all of them with the reason.
    """
    if format_name == "tum" and records == "measurements":
        raise click.UsageError("TUM holds poses only; export measurements with --format csv")
    lines: Iterable[str]
    if records == "measurements":
        lines = measurement_csv(_load(recording, keep_going=keep_going).measurements)
    else:
        poses = _poses_of(recording, keep_going=keep_going)
        lines = pose_csv(poses) if format_name == "csv" else tum_lines(valid_records(poses))
    if output == STDOUT:
        sys.stdout.writelines(lines)
    else:
        refuse_to_replace([recording], output)
        _write_text(output, lines)


def _load(
    path: Path,
    *,
    keep_going: bool,
    rate_hz: float | None = None,
    frames: Path | None = None,
    prisms: Path | None = None,
) -> Recording:
    """Read a recording, and put what the user gives in place of what was recorded."""
    recording = load_recording(path, keep_going=keep_going, on_problem=report_problem)
    parameters = recording.parameters
    if rate_hz is not None:
        pipeline = dataclasses.replace(parameters.pipeline, period_ns=round(1e9 / rate_hz))
        parameters = dataclasses.replace(parameters, pipeline=pipeline)
    if frames is not None:
        if not has_raw_angles(recording.measurements):
            raise click.UsageError(
                f"{path} holds points in frame station1 only; --frames has nothing to change"
            )
        parameters = with_frames(parameters, load_station_frames(frames), path=frames)
    if prisms is not None:
        parameters = with_layout(parameters, load_prism_layout(prisms), path=prisms)
    return dataclasses.replace(recording, parameters=parameters)


def _poses_of(path: Path, *, keep_going: bool) -> Iterable[PoseRecord]:
    """Poses as they stand in a recording; where it has none, those that its measurements give."""
    recorded = _recorded_poses(path, keep_going=keep_going)
    first = next(recorded, None)
    if first is not None:
        return itertools.chain([first], recorded)
    click.echo(f"{path} holds no poses; processing its measurements", err=True)
    return process_recording(_load(path, keep_going=keep_going), path=path).records()


def _recorded_poses(path: Path, *, keep_going: bool) -> Iterator[PoseRecord]:
    for line in read_lines(path, keep_going=keep_going, on_problem=report_problem):
        if line.type == "pose":
            try:
                yield decode_line(PoseRecord, line, path)
            except CorruptLineError as problem:
                if not keep_going:
                    raise
                report_problem(problem)


def _write_text(output: Path, lines: Iterable[str]) -> None:
    with write_atomically(output) as file:
        file.writelines(line.encode() for line in lines)


def _progress(
    records: Iterable[PoseRecord], length: int, label: str
) -> AbstractContextManager[Iterable[PoseRecord]]:
    if not sys.stderr.isatty():
        return nullcontext(records)
    return click.progressbar(records, length=length, label=label, file=sys.stderr)


def _pose_counts(poses: PoseBatch) -> dict[str, Any]:
    return {
        "poses": len(poses),
        "valid_poses": int(np.count_nonzero(poses.valid)),
        "invalid": poses.invalid_counts(),
    }


def _pose_summary(poses: PoseBatch) -> str:
    counts = _pose_counts(poses)
    invalid = "".join(f", {reason} {count}" for reason, count in counts["invalid"].items())
    return f"{counts['valid_poses']} of {counts['poses']} poses valid{invalid}"


def _duration_s(poses: PoseBatch) -> float:
    return int(poses.stamp_ns[-1] - poses.stamp_ns[0]) / 1e9


def _figures(pairs: Sequence[PairDistances]) -> dict[str, Any]:
    return {pair.name: dataclasses.asdict(pair.summary()) for pair in pairs}


def _print_pairs(pairs: Sequence[PairDistances]) -> None:
    rows = []
    for pair in pairs:
        found = pair.summary()
        figures = (found.reference, found.mean, found.std, found.mean_abs_error, found.p95)
        rows.append([pair.name, str(found.valid), *("-" if math.isnan(f) else f"{f:.2f}" for f in figures)])
    print_table(["pair", "n", "reference", "mean", "std", "mean |error|", "p95 |error|"], rows)
