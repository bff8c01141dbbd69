"""The command ``export``."""

from __future__ import annotations

import itertools
import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from tsgt.analysis.formats import measurement_csv, messages, pose_csv, tum_lines, valid_records, write_mcap
from tsgt.analysis.processing import process
from tsgt.cli.desk.unused_options import refuse_unused_by_linear, refuse_unused_wheels
from tsgt.cli.options import (
    FiniteRange,
    keep_going_option,
    path_type,
    point_option,
    recording_argument,
    reference_point_option,
    resolved_point,
    unknown_suffix,
)
from tsgt.cli.output import refuse_overwrite, report_problem, require_extra
from tsgt.cli.progress import TUNING, progress
from tsgt.cli.recordings import ImuOptions, imu_options, load, load_reference, write_lines
from tsgt.errors import CorruptLineError, RecordingError
from tsgt.estimation import records_at
from tsgt.model import ROBOT_ORIGIN, Parameters, ReferencePoint
from tsgt.recording import (
    PoseRecord,
    decode_line,
    load_recording,
    read_lines,
    replaced_line,
    write_atomically,
)

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator

    from tsgt.recording import Kind, Recording

T = TypeVar("T")

STDOUT = Path("-")

_WHY_INVALID = "--format csv tells why each pose is invalid"

_FINAL = ("interpolated", "smoothed")

FORMATS = {".tum": "tum", ".csv": "csv", ".mcap": "mcap"}


@click.command()
@recording_argument
@click.option(
    "--format",
    "format_name",
    type=click.Choice(list(FORMATS.values())),
    help="TUM for evo, CSV for spreadsheets, MCAP (ROS 2 messages) for Foxglove and bag readers.  "
    "[default: from the suffix of --output]",
)
@click.option(
    "--records",
    type=click.Choice(["poses", "measurements"]),
    default="poses",
    help="Content of a CSV file. TUM contains poses, MCAP poses and prism positions.",
)
@click.option(
    "--kind",
    type=click.Choice(["interpolated", "predicted", "smoothed"]),
    help="Kind of poses, if a recording contains several.  [default: interpolated and smoothed]",
)
@click.option(
    "--delay-s",
    type=FiniteRange(min=0, min_open=True),
    help="Smoothed poses of this delay, as they were streamed before the final ones.  [default: the final ones]",
)
@click.option(
    "--reference",
    "reference_path",
    type=path_type,
    help="Reference trajectory to add to an MCAP file: TUM, in the frame of station 1.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path, allow_dash=True),
    default=STDOUT,
    show_default=False,
    help="File to write: .tum, .csv or .mcap.  [default: stdout, except for MCAP]",
)
@point_option()
@reference_point_option
@imu_options
@keep_going_option
def export(
    *,
    recording: Path,
    format_name: str | None,
    records: str,
    kind: Kind | None,
    delay_s: float | None,
    reference_path: Path | None,
    output: Path,
    point: ReferencePoint | str | None,
    reference_point: ReferencePoint | str | None,
    imu: ImuOptions,
    keep_going: bool,
) -> None:
    """Convert a recording to TUM, CSV or MCAP.

    Exports the poses of the recording; a recording without poses is processed first. If an epoch has a predicted and
    a smoothed pose, the final smoothed one is exported. TUM and MCAP contain valid poses only, CSV all poses with the reason
    why one is invalid.
    """
    if format_name is None:
        if output == STDOUT:
            raise click.UsageError("give --format, or --output with a suffix that selects it")
        if output.suffix not in FORMATS:
            raise click.UsageError(unknown_suffix(output, tuple(FORMATS)))
        format_name = FORMATS[output.suffix]
    if delay_s is not None and kind not in (None, "smoothed"):
        raise click.UsageError(f"{kind} poses have no delay; --delay-s selects smoothed ones")
    series = kind if delay_s is None else f"smoothed_{delay_s:g}s"
    if records == "measurements" and format_name != "csv":
        raise click.UsageError(
            "TUM contains poses only, MCAP poses and prism positions; export raw measurements with --format csv"
        )
    if records == "measurements" and (
        series is not None or point is not None or reference_point is not None or imu != ImuOptions()
    ):
        raise click.UsageError(
            "raw measurements are exported as recorded: --kind, --delay-s, --point, --reference-point and options of the IMU "
            "choose poses"
        )
    if reference_path is not None and format_name != "mcap":
        raise click.UsageError("--reference needs --format mcap; `tsgt evaluate --reference` compares")
    if reference_point is not None and reference_path is None:
        raise click.UsageError("--reference-point needs --reference")
    if format_name == "mcap":
        if output == STDOUT:
            raise click.UsageError("MCAP is binary and is not written to stdout; give --output FILE")
        require_extra("MCAP files", "mcap.writer", "rosbags.typesys", extra="mcap")
    if output != STDOUT:
        refuse_overwrite([recording, reference_path, imu.samples, imu.setup, imu.odometry], output)
    loaded = None
    if imu != ImuOptions():  # its mounting may be another one
        _refuse_recorded(recording, series, keep_going=keep_going)
        loaded = load(recording, keep_going=keep_going, point=point, imu=imu)
        point = loaded.parameters.reference_point
    else:
        point = _point(point, recording)
    if format_name == "mcap":
        loaded = loaded or load(recording, keep_going=keep_going, point=point, imu=imu)
        reference = load_reference(reference_path, reference_point, loaded.parameters)
        poses = _poses_of(recording, series, point, imu, keep_going=keep_going, loaded=loaded)
        with write_atomically(output) as file:
            write_mcap(file, messages(loaded, _noting_none_valid(poses, recording), reference))
        return
    lines: Iterable[str]
    if records == "measurements":
        # Those before another set-up, and without any, are as recorded, too.
        raw = load_recording(recording, whole=True, keep_going=keep_going, on_problem=report_problem)
        if not raw.measurements:
            raise RecordingError("has no measurements", path=recording)
        lines = measurement_csv(raw.measurements)
    else:
        poses = _poses_of(
            recording, series, point, imu, keep_going=keep_going, quiet=output == STDOUT, loaded=loaded
        )
        lines = (
            pose_csv(poses)
            if format_name == "csv"
            else tum_lines(_at_least_one(valid_records(poses), recording), point)
        )
    if output == STDOUT:
        sys.stdout.writelines(lines)
    else:
        write_lines(output, lines)


def _at_least_one(valid: Iterable[T], path: Path) -> Iterator[T]:
    """Yield what is in a list of valid poses; raises RecordingError if nothing is."""
    poses = iter(valid)
    first = next(poses, None)
    if first is None:
        raise RecordingError(f"has no valid pose; {_WHY_INVALID}", path=path)
    yield first
    yield from poses


def _noting_none_valid(poses: Iterable[PoseRecord], path: Path) -> Iterator[PoseRecord]:
    """Yield poses; say so if none is valid: of those an MCAP file has only the prisms."""
    some = False
    for pose in poses:
        some |= pose.valid
        yield pose
    if not some:
        click.echo(f"note: {path} has no valid pose, only positions of prisms; {_WHY_INVALID}", err=True)


def _point(point: ReferencePoint | str | None, path: Path) -> ReferencePoint:
    """Return the point that is given, or else the reference point of a recording's first session.

    The later sessions are carried over to it.
    """
    if isinstance(point, ReferencePoint):
        return point
    for line in read_lines(path, keep_going=True):
        if line.type == "parameters":
            with suppress(CorruptLineError):  # reported, or skipped, when the poses are read
                first = decode_line(Parameters, line, path)
                return first.reference_point if point is None else resolved_point(point, first)
    return ROBOT_ORIGIN


def _refuse_recorded(path: Path, series: str | None, *, keep_going: bool) -> None:
    """Raise UsageError for options of the IMU if there are poses."""
    recorded = _recorded_poses(path, series, keep_going=keep_going, quiet=True, reported=False)
    if next(recorded, None) is not None:
        recorded.close()
        raise click.UsageError(
            f"{path} holds poses, which are exported as they are: options of the IMU have no effect; `tsgt process` computes "
            "poses with them"
        )


def _poses_of(
    path: Path,
    series: str | None,
    point: ReferencePoint,
    imu: ImuOptions,
    *,
    keep_going: bool,
    quiet: bool = False,
    loaded: Recording | None = None,
) -> Iterator[PoseRecord]:
    """Return the poses of a recording, carried over to a point; if it has none, compute them.

    ``quiet`` suppresses the progress bar, which would mix with lines on the terminal. Problems of a recording that is
    ``loaded`` have been reported already.
    """
    recorded = _recorded_poses(path, series, keep_going=keep_going, quiet=quiet, reported=loaded is not None)
    first = next(recorded, None)
    if first is None:
        return _computed(path, series, point, imu, keep_going=keep_going, loaded=loaded)
    return _carried_over(itertools.chain([first], recorded), point)


def _carried_over(
    recorded: Iterable[tuple[ReferencePoint, PoseRecord]], point: ReferencePoint
) -> Iterator[PoseRecord]:
    for own_point, poses in itertools.groupby(recorded, key=lambda pair: pair[0]):
        of_point = (pose for _, pose in poses)
        yield from of_point if own_point == point else records_at(of_point, own_point, point)


def _computed(
    path: Path,
    series: str | None,
    point: ReferencePoint,
    imu: ImuOptions,
    *,
    keep_going: bool,
    loaded: Recording | None,
) -> Iterator[PoseRecord]:
    """Yield computed poses of a recording that has none of the series."""
    if series is not None:
        kind, _, delay = series.partition("_")
        which, option = (f"{kind} poses at {delay}", "--delay-s") if delay else (f"{kind} poses", "--kind")
        raise RecordingError(f"holds no {which}; omit {option} to export or compute other poses", path=path)
    click.echo(f"{path} holds no poses; processing its measurements", err=True)
    with progress("fitting", first=TUNING) as on_progress:
        loaded = loaded or load(path, keep_going=keep_going, point=point, imu=imu)
        refuse_unused_by_linear(loaded, path, imu)
        refuse_unused_wheels(loaded, path, imu)
        batch = process(loaded, path=path, on_progress=on_progress)
    yield from batch.records()


def _recorded_poses(
    path: Path, series: str | None, *, keep_going: bool, quiet: bool, reported: bool
) -> Generator[tuple[ReferencePoint, PoseRecord], None, None]:
    """Yield the poses of a series (default: interpolated and final ones), each with its point.

    Those before a set-up that was replaced while the master ran are left out: the tripods may have stood elsewhere. Raises
    RecordingError: runs that were joined overlap, or have different set-ups.
    """
    parameters: Parameters | None = None  # of the run
    set_up: Parameters | None = None  # of the last pose
    first_line, left_out = replaced_line(path), 0
    last: PoseRecord | None = None
    on_problem = None if reported else report_problem
    done_bytes = 0
    with nullcontext() if quiet else progress("exporting") as on_progress:
        for line in read_lines(path, keep_going=keep_going, on_problem=on_problem):
            done_bytes += len(line.data) + 1
            if on_progress is not None and line.number % 1000 == 0:
                on_progress(done_bytes / path.stat().st_size)
            if line.type not in ("pose", "parameters"):
                continue
            try:
                if line.type == "parameters":
                    parameters = decode_line(Parameters, line, path)
                    continue
                pose = decode_line(PoseRecord, line, path)
            except CorruptLineError as problem:
                if not keep_going:
                    raise
                report_problem(problem)
            else:
                if pose.series not in (_FINAL if series is None else (series,)):
                    continue
                if line.number < first_line:
                    left_out += 1
                    continue
                if last is not None and pose.stamp_ns <= last.stamp_ns:
                    raise RecordingError(
                        f"line {line.number}: its time is not later than that of the pose before: runs that were joined overlap; export each "
                        "by itself",
                        path=path,
                    )
                if set_up is not None and parameters is not None and not parameters.same_set_up(set_up):
                    raise RecordingError(
                        f"line {line.number}: its set-up is not that of the pose before: runs with different set-ups were joined; export each "
                        "by itself",
                        path=path,
                    )
                last, set_up = pose, parameters
                yield ROBOT_ORIGIN if parameters is None else parameters.reference_point, pose
        if on_progress is not None:
            on_progress(1.0)
    if left_out:
        click.echo(f"note: {path}: {left_out} poses before the set-up was replaced are left out", err=True)
