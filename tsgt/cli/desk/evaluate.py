"""The command ``evaluate``: what measurements and poses say of each other, and of a reference."""

from __future__ import annotations

import dataclasses
import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

import click

from tsgt.analysis.evaluation import held_out, inter_prism, outliers, read_tum, residual_figures
from tsgt.analysis.processing import process
from tsgt.analysis.smoothing import smoothed
from tsgt.cli.desk.reference import against, print_against
from tsgt.cli.desk.report import report_evaluation
from tsgt.cli.options import json_option, keep_going_option, path_type, recording_argument
from tsgt.cli.output import print_json, print_table
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
)
from tsgt.errors import GeometryError, RecordingError
from tsgt.estimation import build_observations, build_tracks

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.evaluation import Align, HeldOut, Outlier, PairDistances
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.smoothing import Smoothed
    from tsgt.cli.desk.reference import Against
    from tsgt.recording import Recording

LISTED_OUTLIERS = 10


@click.command()
@recording_argument
@estimator_option
@click.option(
    "--reference",
    "reference_path",
    type=path_type,
    help="Trajectory to compare with: TUM, of the robot's frame in the frame of station 1.",
)
@click.option(
    "--align",
    type=click.Choice(["none", "translation", "rigid"]),
    default="none",
    show_default=True,
    help="With --reference: align as well, and tell what that hides; unaligned errors are told in any case.",
)
@click.option(
    "--held-out/--no-held-out",
    "with_held_out",
    default=None,
    help="Leave measurements out and predict them, which takes most of the time.  "
    "[default: do; in a report of more than 15 min do not]",
)
@click.option(
    "--report",
    "report_folder",
    type=path_type,
    help="Folder for a report with figures: one HTML page, and PNG and PDF beside it.",
)
@click.option(
    "--odometry",
    type=path_type,
    help="With --report: when the robot stood still, from CSV lines of time_s,linear_mps,angular_radps.  "
    "[default: from the measurements]",
)
@frames_option
@prisms_option
@keep_going_option
@json_option
def evaluate(
    *,
    recording: Path,
    estimator: Estimator | None,
    reference_path: Path | None,
    align: Literal["none", "translation", "rigid"],
    with_held_out: bool | None,
    report_folder: Path | None,
    odometry: Path | None,
    frames: Path | None,
    prisms: Path | None,
    keep_going: bool,
    as_json: bool,
) -> None:
    """Judge RECORDING: by what it says of itself, and by a reference if there is one.

    The distances between its prisms cannot change; each measurement should be what the others predict; no residual
    should be larger than the noise that makes it.
    """
    if odometry is not None and report_folder is None:
        raise click.UsageError("--odometry is for a report; add --report")
    aligning: Align | None = None if align == "none" else align
    if aligning is not None and reference_path is None:
        raise click.UsageError("--align is for a comparison; add --reference")
    loaded = load(recording, keep_going=keep_going, estimator=estimator, frames=frames, prisms=prisms)
    reference = None if reference_path is None else read_tum(reference_path)
    if report_folder is not None:
        report_evaluation(
            loaded,
            recording,
            report_folder,
            reference=reference,
            align=aligning,
            odometry=odometry,
            with_held_out=with_held_out,
            as_json=as_json,
        )
        return
    parameters = loaded.parameters
    with progress("fitting", first=TUNING) as on_progress:
        continuous = smoothed(loaded, path=recording, on_progress=on_progress)
    if parameters.pipeline.estimator == "continuous":
        poses = continuous.poses
    else:
        poses = process(loaded, path=recording)
    found = inter_prism(parameters, build_tracks(parameters, loaded.measurements))
    left_out = _held_out(loaded, continuous, recording) if with_held_out is not False else None
    strays = outliers(continuous.fit, continuous.sources)
    residuals = residual_figures(continuous.fit, continuous.sources)
    compared: dict[Estimator, Against] = {}
    if reference is not None and reference_path is not None:
        paths = (recording, reference_path)
        compared = against(loaded, continuous, reference, paths, still_ns=found.still_ns, align=aligning)
    if as_json:
        chosen = compared.get(parameters.pipeline.estimator)
        print_json(
            {
                "estimator": parameters.pipeline.estimator,
                "duration_s": duration_s(poses),
                **pose_counts(poses),
                "epochs": found.epochs,
                "invalid_epochs": found.invalid_epochs,
                "inter_prism_mm": _figures(found.dynamic),
                "still_s": found.still_s,
                "inter_prism_static_mm": _figures(found.static),
                **({} if left_out is None else {"held_out_mm": _held_out_keys(left_out)}),
                **motion_keys(continuous.motion),
                "residuals": {
                    station: {axis: dataclasses.asdict(figures) for axis, figures in axes.items()}
                    for station, axes in residuals.items()
                },
                "outliers": [dataclasses.asdict(stray) for stray in strays],
                **({} if chosen is None else chosen.keys()),
                **(
                    {"estimators": {name: each.keys() for name, each in compared.items()}} if compared else {}
                ),
            }
        )
        return
    click.echo(f"{pose_summary(poses)} over {duration_s(poses):.1f} s")
    valid = found.epochs - found.invalid_epochs
    click.echo(
        f"\nDistances between prisms at 20 Hz, interpolated: {valid} of {found.epochs} epochs valid (mm)"
    )
    _print_pairs(found.dynamic)
    click.echo(f"\nDistances between prisms standing still, raw pairs within {found.still_s:.1f} s (mm)")
    _print_pairs(found.static)
    if left_out is not None:
        click.echo("\nMeasurements predicted from the others, by how much they were missed (mm)")
        _print_held_out(left_out)
    click.echo(f"\n{motion_text(continuous.motion)}")
    click.echo("\nResiduals of the continuous trajectory, in the sigmas that they should have")
    rows = [
        [
            f"{station} {axis.replace('_', ' ')}",
            str(f.n),
            *_numbers(f.mean, f.std),
            f"{f.beyond_3_sigma:.2%}",
        ]
        for station, axes in residuals.items()
        for axis, f in axes.items()
    ]
    print_table(["station", "n", "mean", "std", "beyond 3"], rows)
    _print_outliers(strays)
    if compared and reference_path is not None:
        print_against(compared, reference_path, aligning)


def _held_out(loaded: Recording, continuous: Smoothed, path: Path) -> dict[Estimator, HeldOut]:
    # The fit's own measurements carry the noise as it was found; what is held out must not have told of that.
    observations, _ = build_observations(
        loaded.parameters, continuous.sources, origin_ns=continuous.origin_ns
    )
    try:
        with progress("predicting left-out measurements") as on_progress:
            return held_out(observations, loaded.parameters.pipeline, on_progress=on_progress)
    except GeometryError as error:
        raise RecordingError(str(error), path=path) from error


def _held_out_keys(left_out: dict[Estimator, HeldOut]) -> dict[str, Any]:
    return {
        name: {**dataclasses.asdict(each.figures), "gaps": dataclasses.asdict(each.gaps)}
        for name, each in left_out.items()
    }


def _figures(pairs: Sequence[PairDistances]) -> dict[str, Any]:
    return {pair.name: dataclasses.asdict(pair.summary()) for pair in pairs}


def _print_pairs(pairs: Sequence[PairDistances]) -> None:
    rows = []
    for pair in pairs:
        found = pair.summary()
        figures = (found.reference, found.mean, found.std, found.mean_abs_error, found.p95)
        rows.append([pair.name, str(found.valid), *_numbers(*figures)])
    print_table(["pair", "n", "reference", "mean", "std", "mean |error|", "p95 |error|"], rows)


def _print_held_out(left_out: dict[Estimator, HeldOut]) -> None:
    rows = []
    for name, each in left_out.items():
        for label, f in ((name, each.figures), (f"{name}, gaps over 1 s", each.gaps)):
            rows.append([label, str(f.n), *_numbers(f.mean, f.median, f.p95)])
    print_table(["estimator", "n", "mean", "median", "p95"], rows)


def _print_outliers(strays: Sequence[Outlier]) -> None:
    if not strays:
        return
    click.echo(f"\nMeasurements that stray too far to be noise: {len(strays)}")
    rows = [
        [
            datetime.fromtimestamp(stray.stamp_ns / 1e9, UTC).isoformat(sep=" ", timespec="milliseconds")[
                :-6
            ],
            str(stray.station),
            str(stray.prism),
            f"{stray.missed_mm:.1f}",
            f"{stray.sigmas:.1f}",
        ]
        for stray in strays[:LISTED_OUTLIERS]
    ]
    print_table(["time (UTC)", "station", "prism", "mm", "sigmas"], rows)
    if len(strays) > LISTED_OUTLIERS:
        click.echo(f"... and {len(strays) - LISTED_OUTLIERS} more; --json has all")


def _numbers(*figures: float) -> list[str]:
    return ["-" if math.isnan(figure) else f"{figure:.2f}" for figure in figures]
