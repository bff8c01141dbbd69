"""The command ``export``."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsgt.analysis.evaluation import read_tum
from tsgt.analysis.formats import measurement_csv, messages, pose_csv, tum_lines, valid_records, write_mcap
from tsgt.analysis.processing import process
from tsgt.cli.options import keep_going_option, path_type, recording_argument
from tsgt.cli.recordings import TUNING, load, progress, refuse_to_replace, report_problem, write_lines
from tsgt.errors import CorruptLineError, RecordingError
from tsgt.recording import PoseRecord, decode_line, read_lines, write_atomically

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from tsgt.recording import Kind, Recording

STDOUT = Path("-")


@click.command()
@recording_argument
@click.option(
    "--format",
    "format_name",
    type=click.Choice(["tum", "csv", "mcap"]),
    required=True,
    help="TUM for evo, CSV for spreadsheets, MCAP (ROS 2 messages) for Foxglove and bag readers.",
)
@click.option(
    "--records",
    type=click.Choice(["poses", "measurements"]),
    default="poses",
    show_default=True,
    help="What a CSV file holds; TUM holds poses, MCAP poses and prism positions.",
)
@click.option(
    "--kind",
    type=click.Choice(["interpolated", "predicted", "smoothed"]),
    help="Which poses of a recording that holds several.  [default: all but predicted ones]",
)
@click.option(
    "--reference",
    "reference_path",
    type=path_type,
    help="MCAP only: a trajectory to look at beside the poses; TUM, of the robot's frame in the frame of station 1.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path, allow_dash=True),
    default=STDOUT,
    help="File to write.  [default: stdout; MCAP needs a file]",
)
@keep_going_option
def export(
    *,
    recording: Path,
    format_name: str,
    records: str,
    kind: Kind | None,
    reference_path: Path | None,
    output: Path,
    keep_going: bool,
) -> None:
    """Write the poses or measurements of RECORDING for other programs.

    Poses are those that stand in the recording as they were streamed or processed; a recording without any is
    processed first. Of each epoch that was both predicted and smoothed, the smoothed pose is taken. TUM and MCAP get
    the valid poses, CSV all of them with the reason.
    """
    if records == "measurements" and format_name != "csv":
        raise click.UsageError(
            "TUM holds poses only, MCAP poses and prism positions; export raw measurements with --format csv"
        )
    if reference_path is not None and format_name != "mcap":
        raise click.UsageError("--reference is for --format mcap; tsgt evaluate --reference compares")
    if output == STDOUT and format_name == "mcap":
        raise click.UsageError("an MCAP file is not for the terminal; give --output FILE")
    if output != STDOUT:
        refuse_to_replace([recording, reference_path], output)
    if format_name == "mcap":
        reference = None if reference_path is None else read_tum(reference_path)
        loaded = load(recording, keep_going=keep_going)
        poses = _poses_of(recording, kind, keep_going=keep_going, loaded=loaded)
        with write_atomically(output) as file:
            write_mcap(file, messages(loaded, poses, reference))
        return
    lines: Iterable[str]
    if records == "measurements":
        lines = measurement_csv(load(recording, keep_going=keep_going).measurements)
    else:
        poses = _poses_of(recording, kind, keep_going=keep_going, quiet=output == STDOUT)
        lines = pose_csv(poses) if format_name == "csv" else tum_lines(valid_records(poses))
    if output == STDOUT:
        sys.stdout.writelines(lines)
    else:
        write_lines(output, lines)


def _poses_of(
    path: Path, kind: Kind | None, *, keep_going: bool, quiet: bool = False, loaded: Recording | None = None
) -> Iterator[PoseRecord]:
    """Yield the poses as they stand in a recording; where it has none, those that its measurements give.

    No bar is shown when ``quiet``: it would stand among the lines on the terminal. Of what is ``loaded`` already, the
    user has been told what could not be read.
    """
    found = False
    for pose in _recorded_poses(path, keep_going=keep_going, quiet=quiet, told=loaded is not None):
        if pose.kind != "predicted" if kind is None else pose.kind == kind:
            found = True
            yield pose
    if found:
        return
    if kind is not None:
        raise RecordingError(
            f"holds no {kind} poses; leave --kind out to take or compute what there is", path=path
        )
    click.echo(f"{path} holds no poses; processing its measurements", err=True)
    with progress("fitting", first=TUNING) as on_progress:
        batch = process(loaded or load(path, keep_going=keep_going), path=path, on_progress=on_progress)
    yield from batch.records()


def _recorded_poses(path: Path, *, keep_going: bool, quiet: bool, told: bool) -> Iterator[PoseRecord]:
    on_problem = None if told else report_problem
    done_bytes = 0
    with nullcontext() if quiet else progress("exporting") as on_progress:
        for line in read_lines(path, keep_going=keep_going, on_problem=on_problem):
            done_bytes += len(line.data) + 1
            if on_progress is not None and line.number % 1000 == 0:
                on_progress(done_bytes / path.stat().st_size)
            if line.type != "pose":
                continue
            try:
                pose = decode_line(PoseRecord, line, path)
            except CorruptLineError as problem:
                if not keep_going:
                    raise
                report_problem(problem)
            else:
                yield pose
        if on_progress is not None:
            on_progress(1.0)
