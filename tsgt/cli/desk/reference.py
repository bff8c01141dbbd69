"""What ``tsgt evaluate`` says of poses against a reference: unaligned, aligned, and standing still."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.evaluation import compare, compare_aligned, stationary_errors
from tsgt.analysis.processing import process, with_estimator
from tsgt.cli.output import print_table
from tsgt.errors import DegenerateGeometryError, InputFileError, RecordingError
from tsgt.estimation import PoseBatch

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.evaluation import Align, AlignedErrorStatistics, PoseErrorStatistics, Reference, StationaryStatistics
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.smoothing import SmoothedRecording
    from tsgt.recording import Recording


@dataclass(frozen=True, slots=True)
class Against:
    """One estimator's poses against a reference.

    Attributes
    ----------
    unaligned
        As they are.
    aligned
        After an alignment, if one was asked for.
    standing
        The mean pose of each stop.
    """

    unaligned: PoseErrorStatistics
    aligned: AlignedErrorStatistics | None
    stationary: StationaryStatistics

    def keys(self) -> dict[str, Any]:
        """Put the figures under their names, for ``--json``."""
        return {
            **dataclasses.asdict(self.unaligned),
            "stationary": dataclasses.asdict(self.stationary),
            **({} if self.aligned is None else {"aligned": dataclasses.asdict(self.aligned)}),
        }


def against(
    loaded: Recording,
    continuous: SmoothedRecording,
    reference: Reference,
    paths: tuple[Path, Path],
    *,
    stationary_ns: Sequence[tuple[int, int]],
    align: Align | None,
) -> dict[Estimator, Against]:
    """Compare the poses of both estimators with a reference.

    Parameters
    ----------
    loaded, continuous
        The recording, and its smoothed poses.
    reference
        What they are compared with.
    paths
        Of the recording and of the reference, for messages.
    still_ns
        When the robot stood still.
    align
        How poses are aligned besides; None: not at all.

    Raises
    ------
    InputFileError
        No valid pose has a reference, or the compared positions do not say how to align.
    """
    path, reference_path = paths
    centroid_m = np.mean([prism.position_m for prism in loaded.parameters.prisms], axis=0)
    try:
        linear = process(with_estimator(loaded, "linear"), path=path)
    except RecordingError:
        # It has no valid pose, which is a result as well.
        linear = PoseBatch.blank(np.empty(0, np.int64), continuous.poses.prisms)
    both: tuple[tuple[Estimator, PoseBatch], ...] = (("linear", linear), ("continuous", continuous.poses))
    unaligned = {name: compare(poses, reference, centroid_m) for name, poses in both}
    if not any(found.compared for found in unaligned.values()):
        stamps = np.concatenate([poses.stamp_ns[poses.valid] for _, poses in both])
        raise InputFileError(
            f"has no pose within 0.1 s of a valid one of {path}: it goes from {_span(reference.stamp_ns)}, the valid poses "
            f"from {_span(stamps)} (UTC); 2 s at both ends of the reference do not count",
            path=reference_path,
        )
    try:
        return {
            name: Against(
                unaligned=unaligned[name],
                aligned=None
                if align is None or not unaligned[name].compared
                else compare_aligned(poses, reference, centroid_m, align),
                stationary=stationary_errors(poses, reference, stationary_ns, centroid_m).statistics(),
            )
            for name, poses in both
        }
    except DegenerateGeometryError as error:
        raise InputFileError(
            f"cannot be aligned with --align {align}, which needs a way that is not straight ({error}); use --align "
            "translation or none",
            path=reference_path,
        ) from error


def print_against(found: dict[Estimator, Against], reference_path: Path, align: Align | None) -> None:
    """Print the tables of all that was compared."""
    click.echo(f"\nAgainst {reference_path}, unaligned")
    rows = [
        [
            name,
            str(f.compared),
            *_numbers(f.position_rms_mm, f.orientation_rms_deg, f.nees.mean, f.nees.max),
            "-" if math.isnan(f.nees.above_95) else f"{f.nees.above_95:.1%}",
        ]
        for name, each in found.items()
        for f in (each.unaligned,)
    ]
    print_table(["estimator", "n", "rms mm", "rms deg", "NEES (6)", "largest", "above 95 %"], rows)
    rows = [
        [
            f"{name}, aligned",
            *_numbers(a.position_rms_mm, a.orientation_rms_deg, a.translation_mm),
            f"{a.rotation_deg:.3f}",
            *_numbers(a.hidden_position_mm, a.hidden_orientation_deg),
        ]
        for name, each in found.items()
        for a in (each.aligned,)
        if a is not None
    ]
    if rows:
        click.echo(
            f"\nAligned ({align}): what is left, what was removed, and how much of the error that hides"
        )
        print_table(
            ["estimator", "rms mm", "rms deg", "shifted mm", "turned deg", "hides mm", "hides deg"], rows
        )
    rows = [
        [
            f"{name}, stops",
            str(s.stops),
            *_numbers(s.position_mean_mm, s.position_max_mm),
            *(f"{value:.3f}" for value in (s.rotation_mean_deg, s.rotation_max_deg)),
        ]
        for name, each in found.items()
        for s in (each.stationary,)
        if s.stops
    ]
    if rows:
        click.echo("\nThe mean pose of each stop, unaligned: mean and largest error")
        print_table(["estimator", "n", "mean mm", "largest mm", "mean deg", "largest deg"], rows)


def _span(stamp_ns: np.ndarray[Any, np.dtype[np.int64]]) -> str:
    first, last = (datetime.fromtimestamp(int(t) / 1e9, UTC) for t in (stamp_ns.min(), stamp_ns.max()))
    return f"{first:%Y-%m-%d %H:%M:%S} to {last:%Y-%m-%d %H:%M:%S}"


def _numbers(*figures: float) -> list[str]:
    return ["-" if math.isnan(figure) else f"{figure:.2f}" for figure in figures]
