"""The command ``evaluate``: internal consistency of a recording, and errors against a reference."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

import click

from tsgt.analysis.diagnosis import diagnose_smoothed
from tsgt.analysis.evaluation import (
    PREDICTOR_NAMES,
    compare_live,
    held_out_errors,
    held_out_keys,
    inter_prism,
    outliers,
    residual_statistics,
)
from tsgt.analysis.inertial_smoothing import imu_keys
from tsgt.analysis.processing import process
from tsgt.analysis.refinement import refinement_keys, refinement_text
from tsgt.analysis.smoothing import smooth_recording
from tsgt.cli.desk.live_poses import print_live
from tsgt.cli.desk.reference import compare_estimators, print_comparisons
from tsgt.cli.desk.report import assess, print_verdicts, refuse_report, report_evaluation
from tsgt.cli.desk.unused_options import refuse_unused_wheels
from tsgt.cli.options import (
    json_option,
    keep_going_option,
    path_type,
    point_option,
    recording_argument,
    reference_point_option,
)
from tsgt.cli.output import numbers, percent, print_json, print_table, require_extra
from tsgt.cli.progress import TUNING, progress
from tsgt.cli.recordings import (
    duration_s,
    estimator_option,
    frames_option,
    imu_options,
    imu_text,
    load,
    load_reference,
    motion_keys,
    motion_text,
    pose_counts,
    pose_summary,
    prisms_option,
    refine_option,
)
from tsgt.errors import GeometryError, RecordingError
from tsgt.estimation import build_tracks

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.diagnosis import Diagnosis
    from tsgt.analysis.evaluation import (
        Align,
        HeldOutErrors,
        InterPrismDistances,
        LiveComparison,
        Outlier,
        PairDistances,
        Predictor,
        Reference,
        ResidualStatistics,
    )
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.refinement import Refine
    from tsgt.analysis.smoothing import SmoothedRecording
    from tsgt.cli.desk.reference import Comparison
    from tsgt.cli.recordings import ImuOptions
    from tsgt.estimation import PoseBatch
    from tsgt.model import ReferencePoint
    from tsgt.recording import Recording

LISTED_OUTLIERS = 10


@click.command()
@recording_argument
@estimator_option
@click.option(
    "--reference",
    "reference_path",
    type=path_type,
    help="Reference trajectory: TUM, in the frame of station 1.",
)
@point_option()
@reference_point_option
@click.option(
    "--align",
    type=click.Choice(["none", "translation", "rigid"]),
    default="none",
    help="With --reference: print errors after this alignment as well, and what it hides.",
)
@click.option(
    "--held-out/--no-held-out",
    "with_held_out",
    default=True,
    show_default=True,
    help="Compute the held-out prediction error; in recordings of more than 15 min for a sample of the measurements.",
)
@click.option(
    "--report",
    "report_folder",
    type=path_type,
    help="Folder for a report: one HTML page, with its figures as PNG and PDF. Needs tsgt[report].",
)
@click.option(
    "--odometry",
    type=path_type,
    help="With --report: CSV of time_s,linear_mps,angular_radps that defines the stationary intervals.  "
    "[default: from the measurements]",
)
@frames_option
@prisms_option
@refine_option
@imu_options
@keep_going_option
@json_option
def evaluate(
    *,
    recording: Path,
    estimator: Estimator | None,
    reference_path: Path | None,
    point: ReferencePoint | str | None,
    reference_point: ReferencePoint | str | None,
    align: Literal["none", "translation", "rigid"],
    with_held_out: bool,
    report_folder: Path | None,
    odometry: Path | None,
    frames: Path | None,
    prisms: Path | None,
    refine: Refine,
    imu: ImuOptions,
    keep_going: bool,
    as_json: bool,
) -> int:
    """Assess the accuracy of a recording.

    Prints a verdict, then internal consistency (distances between prisms, which are constant on a rigid robot;
    residuals against the stated noise), held-out prediction errors, and errors against a reference. Errors and sigmas of
    positions are those of the robot's origin, or of --point, and of the centroid of the prisms.

    Exit code 3: the report was written, but there are no poses, or they could not be compared with the reference.
    """
    if odometry is not None and report_folder is None:
        raise click.UsageError("--odometry needs --report")
    alignment: Align | None = None if align == "none" else align
    if alignment is not None and reference_path is None:
        raise click.UsageError("--align needs --reference")
    if reference_point is not None and reference_path is None:
        raise click.UsageError("--reference-point needs --reference")
    if report_folder is not None:
        inputs = [recording, reference_path, odometry, frames, prisms, imu.samples, imu.setup, imu.odometry]
        refuse_report(inputs, report_folder)
        require_extra("reports", "matplotlib", "jinja2", extra="report")
    loaded = load(
        recording,
        keep_going=keep_going,
        estimator=estimator,
        frames=frames,
        prisms=prisms,
        point=point,
        imu=imu,
    )
    refuse_unused_wheels(loaded, recording, imu)
    reference = load_reference(reference_path, reference_point, loaded.parameters)
    if report_folder is not None:
        return report_evaluation(
            loaded,
            recording,
            report_folder,
            reference=reference,
            reference_path=reference_path,
            align=alignment,
            odometry=odometry,
            with_held_out=with_held_out,
            refine=refine,
            as_json=as_json,
        )
    found = _evaluated(
        loaded,
        recording,
        reference,
        reference_path,
        align=alignment,
        with_held_out=with_held_out,
        refine=refine,
        keep_going=keep_going,
    )
    if as_json:
        print_json(_keys(found))
    else:
        _print_evaluation(found, reference_path, alignment)
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Evaluation:
    """What is printed of a recording."""

    recording: Recording
    path: Path
    continuous: SmoothedRecording
    poses: PoseBatch  # Of the recording's estimator
    distances: InterPrismDistances
    held_out: dict[Predictor, HeldOutErrors] | None
    outliers: list[Outlier]
    residuals: dict[int, dict[str, ResidualStatistics]]
    diagnosis: Diagnosis | None
    comparisons: dict[Estimator, Comparison]  # With the reference
    live: LiveComparison | None


def _evaluated(
    loaded: Recording,
    path: Path,
    reference: Reference | None,
    reference_path: Path | None,
    *,
    align: Align | None,
    with_held_out: bool,
    refine: Refine,
    keep_going: bool,
) -> _Evaluation:
    """Evaluate a recording."""
    parameters = loaded.parameters
    with progress("fitting", first=TUNING) as on_progress:
        continuous = smooth_recording(loaded, path=path, refine=refine, on_progress=on_progress)
    poses = continuous.poses
    if parameters.pipeline.estimator != "continuous":
        poses = process(loaded, path=path)
    distances = inter_prism(parameters, build_tracks(parameters, loaded.measurements))
    held_out = _held_out(loaded, continuous, path, refine) if with_held_out else None
    comparisons: dict[Estimator, Comparison] = {}
    if reference is not None and reference_path is not None:
        paths = (path, reference_path)
        comparisons = compare_estimators(
            loaded, continuous, reference, paths, stationary_ns=distances.stationary_ns, align=align
        )
    return _Evaluation(
        recording=loaded,
        path=path,
        continuous=continuous,
        poses=poses,
        distances=distances,
        held_out=held_out,
        outliers=outliers(continuous.fit, continuous.sources),
        residuals=residual_statistics(continuous.fit, continuous.sources),
        diagnosis=_diagnosis(loaded, continuous, held_out, distances),
        comparisons=comparisons,
        live=compare_live(loaded, path, continuous.poses, reference, keep_going=keep_going),
    )


def _keys(found: _Evaluation) -> dict[str, Any]:
    """Return what ``--json`` prints."""
    parameters, continuous, distances = found.recording.parameters, found.continuous, found.distances
    keys = {
        "estimator": parameters.pipeline.estimator,
        "reference_point": dataclasses.asdict(parameters.reference_point),
        "duration_s": duration_s(found.poses),
        **pose_counts(found.poses),
        "epochs": distances.epochs,
        "invalid_epochs": distances.invalid_epochs,
        "inter_prism_mm": _figures(distances.dynamic),
        "still_s": distances.stationary_s,
        "inter_prism_static_mm": _figures(distances.static),
    }
    if found.diagnosis is not None:
        keys["diagnosis"] = found.diagnosis.numbers()
    if found.held_out is not None:
        keys |= held_out_keys(found.held_out)
    keys |= refinement_keys(continuous.refinement, continuous.parameters)
    keys |= motion_keys(continuous)
    keys |= imu_keys(continuous.imu, continuous.imu_problem)
    keys["residuals"] = {
        station: {axis: dataclasses.asdict(figures) for axis, figures in axes.items()}
        for station, axes in found.residuals.items()
    }
    keys["outliers"] = [dataclasses.asdict(outlier) for outlier in found.outliers]
    chosen = found.comparisons.get(parameters.pipeline.estimator)
    if chosen is not None:
        keys |= chosen.keys()
    if found.comparisons:
        keys["estimators"] = {name: each.keys() for name, each in found.comparisons.items()}
    if found.live is not None:
        keys["live"] = found.live.keys()
    return keys


def _print_evaluation(found: _Evaluation, reference_path: Path | None, align: Align | None) -> None:
    parameters, continuous, distances = found.recording.parameters, found.continuous, found.distances
    errors = {name: each.unaligned for name, each in found.comparisons.items()}
    print_verdicts(assess(found.recording, found.path, continuous, distances, errors, found.diagnosis))
    click.echo(f"\n{pose_summary(found.poses)} over {duration_s(found.poses):.1f} s")
    if distances.dynamic:  # else a single prism was measured
        valid = distances.epochs - distances.invalid_epochs
        click.echo(
            f"\nDistances between prisms at 20 Hz, interpolated: {valid} of {distances.epochs} epochs valid (mm)"
        )
        _print_pairs(distances.dynamic)
        click.echo(
            f"\nDistances between prisms while stationary, raw pairs within {distances.stationary_s:.1f} s (mm)"
        )
        _print_pairs(distances.static)
    if found.held_out is not None:
        click.echo("\nHeld-out prediction error (mm)")
        _print_held_out(found.held_out)
        click.echo(
            "\nThe same errors in the sigmas that covariance and noise state (1 and 0.1 % if they are right)"
        )
        _print_normalised(found.held_out)
    click.echo(f"\n{refinement_text(continuous.refinement, continuous.parameters)}")
    used = imu_text(continuous)
    if used is not None:
        click.echo(f"\n{used}")
    click.echo(f"\n{motion_text(continuous, parameters.pipeline.motion)}")
    _print_residuals(found.residuals)
    _print_outliers(found.outliers)
    if found.comparisons and reference_path is not None:
        print_comparisons(found.comparisons, reference_path, align, parameters.reference_point)
    if found.live is not None:
        print_live(found.live, parameters)


def _diagnosis(
    loaded: Recording,
    continuous: SmoothedRecording,
    predicted: dict[Predictor, HeldOutErrors] | None,
    distances: InterPrismDistances,
) -> Diagnosis | None:
    """Diagnose; None for too few measurements."""
    try:
        with progress("looking for causes of errors"):
            return diagnose_smoothed(loaded.parameters, continuous, held_out=predicted, distances=distances)
    except GeometryError:
        return None


def _held_out(
    loaded: Recording, continuous: SmoothedRecording, path: Path, refine: Refine
) -> dict[Predictor, HeldOutErrors]:
    # Not the observations of the fit: their noise scale was estimated from all measurements, held-out ones included.
    observations = continuous.observations_with(loaded.parameters)
    try:
        with progress("predicting held-out measurements") as on_progress:
            return held_out_errors(
                observations,
                loaded.parameters,
                refine=refine,
                imu=None if continuous.imu is None else continuous.imu.samples,
                on_progress=on_progress,
            )
    except GeometryError as error:
        raise RecordingError(str(error), path=path) from error


def _figures(pairs: Sequence[PairDistances]) -> dict[str, Any]:
    return {pair.name: dataclasses.asdict(pair.statistics()) for pair in pairs}


def _print_pairs(pairs: Sequence[PairDistances]) -> None:
    rows = []
    for pair in pairs:
        found = pair.statistics()
        figures = (found.reference, found.mean, found.std, found.mean_abs_error, found.p95)
        rows.append([pair.name, str(found.valid), *numbers(*figures)])
    print_table(["pair", "n", "reference", "mean", "std", "mean |error|", "p95 |error|"], rows)


def _print_residuals(residuals: dict[int, dict[str, ResidualStatistics]]) -> None:
    click.echo("\nNormalised residuals of the continuous trajectory")
    rows = [
        [f"{station} {axis.replace('_', ' ')}", str(f.n), *numbers(f.mean, f.std), percent(f.beyond_3_sigma)]
        for station, axes in residuals.items()
        for axis, f in axes.items()
    ]
    print_table(["station", "n", "mean", "std", "beyond 3"], rows)


def _print_held_out(predicted: dict[Predictor, HeldOutErrors]) -> None:
    rows = [
        [label, str(f.n), *numbers(f.mean, f.median, f.p95)]
        for name, each in predicted.items()
        for label, f in (
            (PREDICTOR_NAMES[name], each.statistics),
            (f"{PREDICTOR_NAMES[name]}, gaps over 1 s", each.gaps),
        )
    ]
    print_table(["estimator", "n", "mean", "median", "p95"], rows)


def _print_normalised(predicted: dict[Predictor, HeldOutErrors]) -> None:
    rows = [
        [
            f"{PREDICTOR_NAMES[name]}, {part}, {component.replace('_', ' ')}",
            str(f.n),
            *numbers(f.rms, f.robust),
            f"{f.beyond_3_29_sigma:.1%}",
        ]
        for name, each in predicted.items()
        for part, components in each.normalised_statistics().items()
        if part in ("moving", "stationary")
        for component, f in components.items()
    ]
    print_table(["estimator, part, component", "n", "rms", "rms by median", "beyond 3.29"], rows)


def _print_outliers(rejected: Sequence[Outlier]) -> None:
    if not rejected:
        return
    click.echo(f"\nOutliers: {len(rejected)}")
    rows = [
        [
            datetime.fromtimestamp(each.stamp_ns / 1e9, UTC).isoformat(sep=" ", timespec="milliseconds")[:-6],
            str(each.station),
            str(each.prism),
            f"{each.missed_mm:.1f}",
            f"{each.sigmas:.1f}",
        ]
        for each in rejected[:LISTED_OUTLIERS]
    ]
    print_table(["time (UTC)", "station", "prism", "mm", "sigmas"], rows)
    if len(rejected) > LISTED_OUTLIERS:
        click.echo(f"... and {len(rejected) - LISTED_OUTLIERS} more; --json lists all")
