"""Writing results from the command line, and telling of what could not be read in them.

What the commands of the desk share: options, reading a recording, summing poses up.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click
import numpy as np

import tsgt
from tsgt.analysis.processing import (
    has_raw_angles,
    with_estimator,
    with_frames,
    with_latencies,
    with_layout,
    with_targets,
)
from tsgt.cli.options import path_type
from tsgt.clock import SystemClock
from tsgt.config import load_prism_layout, load_station_frames, load_station_latencies, load_target_residuals
from tsgt.recording import RecordingHeader, encode_line, load_recording, write_atomically

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.smoothing import Motion
    from tsgt.errors import RecordingError
    from tsgt.estimation import PoseBatch
    from tsgt.model import Parameters
    from tsgt.recording import Recording


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


estimator_option = click.option(
    "--estimator",
    type=click.Choice(["linear", "continuous"]),
    help="Straight lines between measurements, or one smooth trajectory through all of them.  [default: as recorded]",
)
frames_option = click.option(
    "--frames", type=path_type, help="Station frames (set-up file) instead of those in the recording."
)
prisms_option = click.option(
    "--prisms", type=path_type, help="Prism layout (set-up file) instead of that in the recording."
)


def load(
    path: Path,
    *,
    keep_going: bool,
    estimator: Estimator | None = None,
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
        parameters = with_latencies(parameters, load_station_latencies(frames))
        parameters = with_targets(parameters, load_target_residuals(frames))
    if prisms is not None:
        parameters = with_layout(parameters, load_prism_layout(prisms), path=prisms)
    recording = dataclasses.replace(recording, parameters=parameters)
    return recording if estimator is None else with_estimator(recording, estimator)


TUNING = "finding how the robot moves"
"""What takes a while before the first share of a fit is known: nobody can say how many steps it will need."""


@contextmanager
def progress(label: str, *, first: str | None = None) -> Iterator[Callable[[float], None] | None]:
    """Give what shows the share of a long computation that is done, where somebody looks at it.

    Parameters
    ----------
    label
        What is being done.
    first
        What is being done until the first share is told, if that is something else.
    """
    if not sys.stderr.isatty():
        yield None
        return
    with click.progressbar(length=1000, label=first or label, file=sys.stderr) as bar:

        def show(share: float) -> None:
            if bar.label != label:
                bar.label = label
                bar.render_progress()
            bar.update(round(1000 * share) - bar.pos)

        yield show


def pose_counts(poses: PoseBatch) -> dict[str, Any]:
    """Count poses, for ``--json``."""
    return {
        "poses": len(poses),
        "valid_poses": int(np.count_nonzero(poses.valid)),
        "invalid": poses.invalid_counts(),
    }


def pose_summary(poses: PoseBatch) -> str:
    """Count poses, for people."""
    counts = pose_counts(poses)
    invalid = "".join(f", {reason} {count}" for reason, count in counts["invalid"].items())
    return f"{counts['valid_poses']} of {counts['poses']} poses valid{invalid}"


def duration_s(poses: PoseBatch) -> float:
    """From the first epoch to the last, in s."""
    return int(poses.stamp_ns[-1] - poses.stamp_ns[0]) / 1e9


def motion_keys(motion: Motion) -> dict[str, Any]:
    """Tell what a trajectory was fitted with, for ``--json``."""
    return {
        "motion": dataclasses.asdict(motion.prior),
        "noise_scale": motion.noise_scale,
        "motion_tuned": motion.tuned,
    }


def motion_text(motion: Motion) -> str:
    """Tell people what a trajectory was fitted with: as it stands in a master's configuration."""
    prior = dataclasses.asdict(motion.prior)
    values = {
        key: "[" + ", ".join(f"{v:.3g}" for v in value) + "]" if isinstance(value, tuple) else f"{value:.3g}"
        for key, value in prior.items()
    }
    origin = "found from the measurements" if motion.tuned else "as recorded: too few measurements to tell"
    lines = [
        f"How the robot moves, {origin}:",
        "  [pipeline]",
        f"  noise_scale = {motion.noise_scale:.3g}",
        "  [pipeline.motion]",
        *(f"  {key} = {value}" for key, value in values.items()),
    ]
    return "\n".join(lines)
