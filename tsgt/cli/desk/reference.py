"""Poses against a reference for ``tsgt evaluate``: unaligned, aligned, and the mean pose of each stop."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.evaluation import compare, compare_aligned, error_details, stationary_errors
from tsgt.analysis.processing import process, with_estimator
from tsgt.cli.output import numbers, print_table
from tsgt.errors import DegenerateGeometryError, InputFileError, RecordingError
from tsgt.estimation import PoseBatch, centroid_at_point, point_label

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from tsgt.analysis.evaluation import (
        Align,
        AlignedErrorStatistics,
        PoseErrorDetails,
        PoseErrorStatistics,
        Reference,
        StationaryStatistics,
    )
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.smoothing import SmoothedRecording
    from tsgt.model import ReferencePoint
    from tsgt.recording import Recording


@dataclass(frozen=True, slots=True)
class Comparison:
    """Errors of one estimator's poses against a reference; ``aligned`` only if an alignment was requested."""

    unaligned: PoseErrorStatistics
    details: PoseErrorDetails
    aligned: AlignedErrorStatistics | None
    stationary: StationaryStatistics

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {
            **dataclasses.asdict(self.unaligned),
            **self.details.keys(),
            "stationary": dataclasses.asdict(self.stationary),
            **({} if self.aligned is None else {"aligned": dataclasses.asdict(self.aligned)}),
        }


def compare_estimators(
    loaded: Recording,
    continuous: SmoothedRecording,
    reference: Reference,
    paths: tuple[Path, Path],
    *,
    stationary_ns: Sequence[tuple[int, int]],
    align: Align | None,
) -> dict[Estimator, Comparison]:
    """Compare the poses of both estimators with a reference.

    Parameters
    ----------
    loaded, continuous
        The recording and its smoothed poses.
    paths
        Of the recording and of the reference, for messages.
    stationary_ns
        Stationary intervals.

    Raises
    ------
    InputFileError
        No valid pose overlaps the reference, or the alignment is degenerate.
    """
    path, reference_path = paths
    centroid_m = centroid_at_point(loaded.parameters)
    try:
        linear = process(with_estimator(loaded, "linear"), path=path)
    except (RecordingError, DegenerateGeometryError):
        # No valid pose, which is a result as well.
        linear = PoseBatch.blank(np.empty(0, np.int64), continuous.poses.prisms)
    both: tuple[tuple[Estimator, PoseBatch], ...] = (("linear", linear), ("continuous", continuous.poses))
    unaligned = {name: compare(poses, reference, centroid_m) for name, poses in both}
    if not any(found.compared for found in unaligned.values()):
        raise not_compared([poses for _, poses in both], reference, paths)
    try:
        return {
            name: Comparison(
                unaligned=unaligned[name],
                details=error_details(poses, reference),
                aligned=None
                if align is None or not unaligned[name].compared
                else compare_aligned(poses, reference, centroid_m, align),
                stationary=stationary_errors(poses, reference, stationary_ns, centroid_m).statistics(),
            )
            for name, poses in both
        }
    except DegenerateGeometryError as error:
        raise not_aligned(str(error), align, reference_path) from error


def not_compared(
    found: Iterable[PoseBatch], reference: Reference, paths: tuple[Path, Path]
) -> InputFileError:
    """Return the error of a reference without a valid pose near it; ``paths`` as for :func:`compare_estimators`."""
    path, reference_path = paths
    stamps = np.concatenate([poses.stamp_ns[poses.valid] for poses in found])
    return InputFileError(
        f"has no pose within 0.1 s of a valid one of {path}: it covers {_span(reference.stamp_ns)}, the valid poses "
        f"{_span(stamps)} (UTC); 2 s at both ends of the reference are not used",
        path=reference_path,
    )


def not_aligned(why: str, align: Align | None, reference_path: Path) -> InputFileError:
    """Return the error of a degenerate alignment."""
    return InputFileError(
        f"cannot be aligned with --align {align}, which needs a path that is not straight ({why}); use --align "
        "translation or none",
        path=reference_path,
    )


def print_comparisons(
    found: dict[Estimator, Comparison], reference_path: Path, align: Align | None, point: ReferencePoint
) -> None:
    """Print the errors as tables, positions at the reference point and at the prisms' centroid."""
    at = f"positions at {point_label(point)} and at the prisms' centroid"
    click.echo(f"\nErrors against {reference_path}, unaligned; {at}")

    def of_points(*figures: str) -> list[str]:
        return [f"{name} {each} mm" for name in (point.name, "centroid") for each in figures]

    rows = [
        [
            name,
            str(f.compared),
            *numbers(f.position_rms_mm, f.centroid.position_rms_mm, f.orientation_rms_deg),
            *numbers(f.nees.mean, f.nees.max),
            "-" if math.isnan(f.nees.above_95) else f"{f.nees.above_95:.1%}",
        ]
        for name, each in found.items()
        for f in (each.unaligned,)
    ]
    print_table(["estimator", "n", *of_points("rms"), "rms deg", "NEES (6)", "max", "above 95 %"], rows)
    rows = [
        [
            f"{name}, aligned",
            *numbers(a.position_rms_mm, a.centroid.position_rms_mm, a.orientation_rms_deg, a.translation_mm),
            *numbers(a.rotation_deg, digits=3),
            *numbers(a.hidden_position_mm, a.hidden_orientation_deg),
        ]
        for name, each in found.items()
        for a in (each.aligned,)
        if a is not None
    ]
    if rows:
        click.echo(
            f"\nAligned ({align}): remaining error, alignment, and the part of the error that it hides; {at}"
        )
        header = [*of_points("rms"), "rms deg", "shift mm", "rotation deg"]
        print_table(["estimator", *header, f"{point.name} hidden mm", "hidden deg"], rows)
    rows = [
        [
            f"{name}, stops",
            str(s.stops),
            *numbers(s.position_mean_mm, s.position_max_mm),
            *numbers(s.centroid.position_mean_mm, s.centroid.position_max_mm),
            *numbers(s.rotation_mean_deg, s.rotation_max_deg, digits=3),
        ]
        for name, each in found.items()
        for s in (each.stationary,)
        if s.stops
    ]
    if rows:
        click.echo(f"\nMean pose of each stop, unaligned: mean and maximum error; {at}")
        print_table(["estimator", "n", *of_points("mean", "max"), "mean deg", "max deg"], rows)
    rows = [
        [
            name,
            f"{each.delta:g} {each.unit}, {'one after the other' if each.pairs == 'consecutive' else 'all'}",
            str(each.errors.n),
            *numbers(
                each.errors.position_mm.rms, each.errors.position_mm.median, each.errors.position_mm.max
            ),
            *numbers(each.errors.orientation_deg.rms, digits=3),
        ]
        for name, comparison in found.items()
        for each in comparison.details.rpe
        if each.errors.n
    ]
    if rows:
        click.echo(f"\nRelative pose errors (RPE) of pairs of poses, at {point_label(point)}")
        print_table(
            [
                "estimator",
                "pairs",
                "n",
                *(f"{point.name} {each} mm" for each in ("rms", "median", "max")),
                "rms deg",
            ],
            rows,
        )


def _span(stamp_ns: np.ndarray[Any, np.dtype[np.int64]]) -> str:
    first, last = (datetime.fromtimestamp(int(t) / 1e9, UTC) for t in (stamp_ns.min(), stamp_ns.max()))
    return f"{first:%Y-%m-%d %H:%M:%S} to {last:%Y-%m-%d %H:%M:%S}"
