"""Report sections on the trajectory: map, pose over time with its sigmas, errors against a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import COMPONENTS, pose_components
from tsgt.analysis.figures import panels_height_mm
from tsgt.analysis.report.figures.components import draw_component_errors, draw_components
from tsgt.analysis.report.figures.poses import draw_map
from tsgt.analysis.report.page import (
    ReportFigure,
    Section,
    Table,
    format_cells,
    format_number,
    format_share,
    format_utc,
)
from tsgt.estimation import Kind
from tsgt.model import PolarMeasurement

if TYPE_CHECKING:
    from tsgt.analysis.evaluation import PoseErrorDetails
    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.report.findings import Findings


def map_figure(f: Findings) -> ReportFigure | None:
    """Return the map; None without a valid pose."""
    poses = f.poses
    if poses is None or not poses.valid.any():
        return None
    stations = {
        s.station: np.array(s.T_station1_station)[:3, 3]
        for s in f.recording.parameters.stations
        if any(isinstance(m, PolarMeasurement) and m.station == s.station for m in f.recording.measurements)
    }
    return ReportFigure(
        "map",
        "Map of the drive",
        f"Path of {f.point} and the stations, from above. The line is interrupted where no pose is valid.",
        110.0,
        lambda figure: draw_map(figure, poses, stations),
    )


def pose_section(f: Findings, axis: TimeAxis) -> Section:
    """Return the section on the pose over time."""
    title = "Pose over time"
    poses = f.poses
    if poses is None:
        return Section(title, ("There are no poses.",))
    how = (
        "fitted to all measurements by a continuous trajectory (estimator continuous)"
        if poses.kind[0] == Kind.SMOOTHED
        else "interpolated linearly between measurements (estimator linear)"
    )
    plot = ReportFigure(
        "trajectory",
        "The six components of the pose, and their stated standard deviations",
        f"Left: x, y, z of {f.point} and roll, pitch, yaw of the robot, in the frame of station 1, with a band of two "
        "standard deviations (often thinner than the line). Right: the standard deviations that the poses state. Lines are "
        "interrupted where no pose is valid.",
        panels_height_mm(6),
        lambda figure: draw_components(figure, pose_components(poses), axis),
    )
    text = f"The poses are {how}. Roll, pitch and yaw are rotations about the axes x, y, z of station 1, in this order."
    return Section(title, (text,), plots=(plot,))


def reference_section(f: Findings, axis: TimeAxis) -> Section | None:
    """Return the section on the errors against the reference; None without one."""
    title = "Errors against the reference"
    if f.reference is None or not f.reference_errors:
        return None
    if not any(e.compared for e in f.reference_errors.values()):
        text = (
            f"The reference does not overlap with valid poses in time: it covers {format_utc(int(f.reference.stamp_ns[0]))} to "
            f"{format_utc(int(f.reference.stamp_ns[-1]))}, the recording {format_utc(f.start_ns)} to {format_utc(f.end_ns)} "
            "(all UTC); 2 s at both ends are excluded."
        )
        return Section(title, (text,))
    text = (
        "Poses minus reference, in the frame of station 1, at the same instants; 2 s at both ends of the reference are "
        "excluded. Nothing is aligned, so errors of the station frames are included."
    )
    not_aligned = (f"Not aligned: {f.problems['aligned']}.",) if "aligned" in f.problems else ()
    name, details = _shown(f)
    plot = ReportFigure(
        "reference_errors",
        f"Error of each component of the pose ({name})",
        f"Black: error of x, y, z of {f.point} and of roll, pitch, yaw. Band: two stated standard deviations to both sides, "
        "which contain 95.4 % of the errors if they are right.",
        panels_height_mm(6),
        lambda figure: draw_component_errors(figure, details.components, axis),
    )
    return Section(title, (text, *not_aligned), (*_tables(f), *_alignment_and_stops(f)), (plot,))


def _shown(f: Findings) -> tuple[Estimator, PoseErrorDetails]:
    """Return name and errors of the estimator that the report shows, or of the other one."""
    poses = f.poses
    compared = {name: each for name, each in f.error_details.items() if each.ate.n}
    name = None if poses is None else Kind(poses.kind[0]).estimator
    return (name, compared[name]) if name in compared else next(iter(compared.items()))


def _tables(f: Findings) -> list[Table]:
    compared = {name: each for name, each in f.error_details.items() if each.ate.n}
    rows = [
        (
            *format_cells(
                name, (a.n, 0), (a.position_mm.rms, 1), (a.position_mm.median, 1), (a.position_mm.max, 1)
            ),
            format_number(f.reference_errors[name].centroid.position_rms_mm),
            *(format_number(value, 3) for value in (a.orientation_deg.rms, a.orientation_deg.max)),
        )
        for name, each in compared.items()
        for a in (each.ate,)
    ]
    columns: tuple[str, ...] = (
        "estimator", "poses", "rms (mm)", "median (mm)", "max (mm)", "centroid rms (mm)", "rms (deg)", "max (deg)",
    )  # fmt: skip
    caption = (
        f"Absolute error (ATE or APE) of the position of {f.point}, beside it at the prisms' centroid, and of the rotation; "
        "unaligned, as evo computes it"
    )
    tables = [Table(caption, columns, tuple(rows))]
    rows = [
        (
            name,
            format_number(f.reference_errors[name].nees.mean),
            format_share(f.reference_errors[name].nees.above_95),
            *(format_share(share) for share in each.components.within_two_sigma),
        )
        for name, each in compared.items()
    ]
    columns = (
        "estimator", "squared error (NEES, expected 6)", "above its 95 % point (expected 5 %)",
        *(f"{name} within 2 sigma" for name in COMPONENTS),
    )  # fmt: skip
    caption = "Errors in units of the covariances that the poses state (expected within 2 sigma: 95.4 %)"
    tables.append(Table(caption, columns, tuple(rows)))
    rows = [
        (
            f"{name}, {r.delta:g} {r.unit}",
            *(format_number(value, digits) for value, digits in (
                (r.errors.n, 0), (r.errors.position_mm.rms, 1), (r.errors.position_mm.max, 1),
                (r.errors.orientation_deg.rms, 3), (r.errors.orientation_deg.max, 3),
            )),
        )
        for name, each in f.error_details.items()
        for r in each.rpe
        if r.errors.n and r.pairs == "all"
    ]  # fmt: skip
    if rows:
        tables.append(
            Table(
                f"Relative error (RPE) of {f.point}: error of the motion over a distance or a time, as evo computes it for "
                "all pairs",
                ("estimator, motion", "pairs", "rms (mm)", "max (mm)", "rms (deg)", "max (deg)"),
                tuple(rows),
            )
        )
    return tables


def _alignment_and_stops(f: Findings) -> list[Table]:
    """Return tables of the aligned errors, if requested, and of the stationary intervals, if there are any."""
    tables = []
    if f.aligned_errors:
        rows = [
            format_cells(
                name,
                *(
                    (a.position_rms_mm, 1),
                    (a.centroid.position_rms_mm, 1),
                    (a.orientation_rms_deg, 3),
                    (a.translation_mm, 1),
                    (a.rotation_deg, 3),
                ),
                *((a.hidden_position_mm, 1), (a.hidden_orientation_deg, 3)),
            )
            for name, a in f.aligned_errors.items()
        ]
        header = "estimator|rms (mm)|centroid rms (mm)|rms (deg)|translation (mm)|rotation (deg)|hidden (mm)|hidden (deg)"
        caption = (
            f"Aligned with the reference: remaining error at {f.point} and at the prisms' centroid, the alignment, and the part of "
            "the rms that it hides"
        )
        tables.append(Table(caption, tuple(header.split("|")), tuple(rows)))
    rows = [
        format_cells(
            name,
            *((s.stops, 0), (s.position_mean_mm, 2), (s.position_max_mm, 2)),
            *((s.centroid.position_mean_mm, 2), (s.centroid.position_max_mm, 2)),
            *((s.rotation_mean_deg, 3), (s.rotation_max_deg, 3)),
        )
        for name, s in f.stationary_errors.items()
        if s.stops
    ]
    if rows:
        header = (
            "estimator|stops|mean (mm)|max (mm)|centroid mean (mm)|centroid max (mm)|mean (deg)|max (deg)"
        )
        caption = f"Error of the mean pose of each stop, at {f.point} and at the prisms' centroid, unaligned"
        tables.append(Table(caption, tuple(header.split("|")), tuple(rows)))
    return tables
