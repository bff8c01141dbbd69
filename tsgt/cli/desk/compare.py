"""The command ``compare``: estimates of other programs against the reference."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, get_args

import click
import numpy as np

from tsgt.analysis.compare import (
    Alignment,
    ExtrinsicPrior,
    FitSettings,
    FittedPart,
    compare_estimate,
    error_csv,
    initial_relation,
    reference_keys,
)
from tsgt.analysis.formats import write_sensor_mounting
from tsgt.analysis.formats.bag import is_bag
from tsgt.analysis.formats.trajectories import read_estimates
from tsgt.analysis.text_file import utf8_name
from tsgt.cli.desk.comparison_reference import read_reference
from tsgt.cli.desk.comparison_report import write_comparison_report
from tsgt.cli.desk.comparison_text import print_comparisons
from tsgt.cli.desk.report import PAGE_NAME, refuse_report
from tsgt.cli.options import FiniteRange, OutputFile, json_option, path_type, point_option
from tsgt.cli.output import print_json, refuse_overwrite, require_extra, require_folder
from tsgt.cli.progress import progress
from tsgt.cli.recordings import write_lines
from tsgt.config import SensorMountingFile, load
from tsgt.errors import GeometryError, TsgtError
from tsgt.geometry import rotation_from_quaternion, transform_from

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.compare import Comparison, Estimate, ReferencePoses, Relation
    from tsgt.model import ReferencePoint

UNKNOWN_POSITION_MM, UNKNOWN_ROTATION_DEG = 1e4, 180.0
"""Sigmas in a file of what the motion did not determine."""


class PartsType(click.ParamType[Any]):
    """Names of fitted parts, separated by commas; or ``none``."""

    name = "parts"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Check the names."""
        if not isinstance(value, str):
            return value
        names = [] if value == "none" else [name.strip() for name in value.split(",")]
        known = get_args(FittedPart)
        for name in names:
            if name not in known:
                self.fail(f"{name!r} is not one of {', '.join(known)}, none", param, ctx)
        return frozenset(names)


@click.command()
@click.argument("reference", type=path_type)
@click.argument("estimates", nargs=-1, required=True, type=path_type, metavar="ESTIMATE...")
@click.option(
    "--fit",
    "parts",
    type=PartsType(),
    default="offset",
    metavar="PARTS",
    help="What is fitted, separated by commas: offset (of the clock), skew (of the clock), extrinsic (of the sensor on the robot), "
    "frame (over all poses, as --align rigid), scale; or none.",
)
@click.option(
    "--align",
    type=click.Choice(get_args(Alignment)),
    help="Alignment of the estimate's frame: none, by the poses at the start, by yaw and position over all, or rigid over all.  "
    "[default: start; rigid with --fit frame]",
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    help="Topic of a bag, or TOPIC:PARENT.CHILD of transforms; may be repeated.  [default: the only one with poses]",
)
@point_option()
@click.option(
    "--extrinsic",
    "extrinsic_path",
    type=path_type,
    help="Mounting of the sensor (TOML, kind sensor_mounting), from CAD or an earlier --output: held, or with --fit extrinsic "
    "the prior.",
)
@click.option(
    "--max-offset-s",
    type=FiniteRange(0.0, 1e9),
    default=60.0,
    help="Largest time offset that is searched.",
)
@click.option(
    "--max-sigma-mm",
    type=FiniteRange(0.0, 1e6, min_open=True),
    help="Leave out poses at which the reference's sigma of the sensor's position, in its least certain direction, exceeds this.",
)
@click.option(
    "--report",
    "report_folder",
    type=path_type,
    help="Folder for a report: one HTML page, with its figures as PNG and PDF. Needs tsgt[report].",
)
@click.option("--csv", "csv_path", type=OutputFile(".csv"), help="File of all errors to write (.csv).")
@click.option(
    "--output",
    type=OutputFile(".toml"),
    help="File of the extrinsic and the time offset to write (.toml), for --extrinsic. With one estimate only.",
)
@json_option
def compare(
    *,
    reference: Path,
    estimates: tuple[Path, ...],
    parts: frozenset[FittedPart],
    align: Alignment | None,
    topics: tuple[str, ...],
    point: ReferencePoint | str | None,
    extrinsic_path: Path | None,
    max_offset_s: float,
    max_sigma_mm: float | None,
    report_folder: Path | None,
    csv_path: Path | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """Compare estimates of other programs with the reference.

    REFERENCE is a recording, or poses of tsgt process. Each ESTIMATE is a TUM, KITTI, EuRoC or CSV file, a ROS 2 bag or an
    MCAP file, of poses or of positions alone. Fits the relation between estimate and reference (clock offset, extrinsic
    of the sensor, frame), with uncertainties, and states the errors that remain, beside what the reference's own
    uncertainty explains. By default only the time offset and the alignment at the start are fitted; the error with
    everything fitted stands beside it.
    """
    if report_folder is not None:
        refuse_report([reference, *estimates, extrinsic_path], report_folder)
        require_extra("reports", "matplotlib", "jinja2", extra="report")
    for path in (csv_path, output):
        refuse_overwrite([reference, *estimates, extrinsic_path], path)
        require_folder(path)
    if topics and not any(map(is_bag, estimates)):
        raise click.UsageError("--topic needs a bag: other files have no topics")
    found = [each for path in estimates for each in read_estimates(path, topics=topics)]
    if output is not None and len(found) != 1:
        raise click.UsageError(f"--output needs one estimate, got {len(found)}")
    settings, start = _settings(parts, align, extrinsic_path, max_offset_s)
    poses = read_reference(reference, point)
    if max_sigma_mm is not None and poses.covariance is None:
        raise click.UsageError(f"--max-sigma-mm needs a reference with covariances; {reference} has none")
    compared = _compare(poses, _with_names(found), settings, start, max_sigma_mm)
    if csv_path is not None:
        write_lines(csv_path, error_csv(compared))
    if output is not None:
        _write_mounting(output, compared[0], reference)
    figures = {
        "reference": reference_keys(poses),
        "estimates": {each.name: each.keys() for each in compared},
    }
    if report_folder is not None:
        write_comparison_report(compared, figures, report_folder, utf8_name(reference.name))
    if as_json:
        print_json(figures)
        return
    print_comparisons(compared)
    if report_folder is not None:
        click.echo(f"\n{report_folder / PAGE_NAME}")


def _settings(
    parts: frozenset[FittedPart], align: Alignment | None, path: Path | None, max_offset_s: float
) -> tuple[FitSettings, Relation]:
    align = align or ("rigid" if "frame" in parts else "start")
    if align == "none" and "frame" in parts:
        raise click.UsageError("--fit frame and --align none contradict each other")
    if align != "none":
        parts |= {"frame"}
    start = initial_relation()
    settings = FitSettings(parts=parts, align=align, max_offset_s=max_offset_s)
    if path is None:
        return settings, start
    mounting = load(path, SensorMountingFile)
    T_point_sensor = transform_from(
        rotation_from_quaternion(np.array(mounting.orientation_xyzw)), np.array(mounting.position_m)
    )
    position_mm = mounting.position_sigma_mm or (UNKNOWN_POSITION_MM,) * 3
    rotation_deg = mounting.rotation_sigma_deg or (UNKNOWN_ROTATION_DEG,) * 3
    sigma = np.concatenate([np.array(position_mm) / 1e3, np.radians(rotation_deg)])
    return (
        dataclasses.replace(settings, extrinsic_prior=ExtrinsicPrior(T_point_sensor, sigma)),
        dataclasses.replace(start, T_point_sensor=T_point_sensor, offset_s=mounting.offset_ms / 1e3),
    )


def _with_names(found: Sequence[Estimate]) -> list[Estimate]:
    """Return the estimates with a name of its own each."""
    taken: set[str] = set()
    named = []
    for each in found:
        name, number = each.name, 1
        while name in taken:
            number += 1
            name = f"{each.name} {number}"
        taken.add(name)
        named.append(dataclasses.replace(each, name=name))
    return named


def _compare(
    reference: ReferencePoses,
    estimates: Sequence[Estimate],
    settings: FitSettings,
    start: Relation,
    max_sigma_mm: float | None,
) -> list[Comparison]:
    compared = []
    with progress("comparing") as on_progress:
        for number, each in enumerate(estimates, start=1):
            try:
                found = compare_estimate(
                    reference,
                    each,
                    settings,
                    start=start,
                    max_sigma_m=None if max_sigma_mm is None else max_sigma_mm / 1e3,
                )
            except GeometryError as problem:
                raise TsgtError(f"{each.source or each.name}: {problem}") from problem
            compared.append(found)
            if on_progress is not None:
                on_progress(number / len(estimates))
    return compared


def _write_mounting(path: Path, found: Comparison, reference: Path) -> None:
    sigma, prior = found.extrinsic_sigma, found.settings.extrinsic_prior
    if prior is not None:  # What was not fitted is known as well as before
        sigma = np.where(np.isfinite(sigma), sigma, prior.sigma)
    elif "extrinsic" in found.settings.parts:
        unknown = np.array([UNKNOWN_POSITION_MM / 1e3] * 3 + [math.radians(UNKNOWN_ROTATION_DEG)] * 3)
        sigma = np.where(np.isfinite(sigma), sigma, unknown)
    write_sensor_mounting(
        path,
        found.fit.relation.T_point_sensor,
        sigma,
        offset_s=None if found.relative_times else found.fit.relation.offset_s,
        offset_sigma_s=float(found.sigma("offset_s")[0]),
        comment=f"written by tsgt compare {reference} {found.estimate.source}",
    )
