"""Report sections on poses: both estimators, the trajectory, residuals, and the effect of prism noise."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import draw_perturbation, panels_height_mm
from tsgt.analysis.report import pose_figures as draw
from tsgt.analysis.report.numbers import difference_numbers, pose_numbers
from tsgt.analysis.report.page import (
    MAX_LISTED,
    ReportFigure,
    Section,
    Table,
    format_cells,
    format_number,
    format_utc,
    page_figure,
)
from tsgt.estimation import Kind, point_label
from tsgt.model import PolarMeasurement

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.report.findings import Findings


def _table(caption: str, columns: str, rows: Sequence[tuple[str, ...]]) -> Table:
    return Table(caption, tuple(columns.split("|")), tuple(rows))


def reference_tables(f: Findings) -> list[Table]:
    """Return tables of the aligned errors, if requested, and of the stationary intervals, if there are any."""
    tables, at = [], point_label(f.recording.parameters.reference_point)
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
        caption = (
            f"Aligned with the reference at {at}: remaining errors there and at the prisms' centroid, the alignment, and the "
            "part of the rms that it hides"
        )
        tables.append(
            _table(
                caption,
                "estimator|rms (mm)|centroid (mm)|rms (deg)|translation (mm)|rotation (deg)|hidden (mm)|hidden (deg)",
                rows,
            )
        )
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
        caption = (
            f"Error of the mean pose of each stationary interval against the reference, unaligned, at {at} and at the prisms' "
            "centroid"
        )
        columns = (
            "estimator|intervals|mean (mm)|max (mm)|centroid mean (mm)|centroid max (mm)|mean (deg)|max (deg)"
        )
        tables.append(_table(caption, columns, rows))
    return tables


def estimator_section(f: Findings, axis: TimeAxis) -> Section:
    """Return the section that compares both estimators."""
    text = [
        f"The estimator {name} yields no poses: {f.problems[name]}."
        for name in ("linear", "continuous")
        if name in f.problems
    ]
    tables, plots = [], []
    at = point_label(f.recording.parameters.reference_point)
    if f.poses_by_estimator:
        tables.append(_poses_of(f))
    if f.held_out is not None:
        rows = [
            format_cells(label, (m.n, 0), (m.mean, 1), (m.median, 1), (m.p95, 1))
            for name, each in f.held_out.items()
            for label, m in ((name, each.statistics), (f"{name}, at gaps over 1 s", each.gaps))
        ]
        tables.append(_table("Held-out prediction error (mm)", "estimator|n|mean|median|95 %", rows))
        held_out = f.held_out
        plots.append(
            page_figure(
                "held_out",
                "Cumulative distribution of the held-out prediction error of each estimator, including the measurement "
                "noise: further up and left is better.",
                65.0,
                lambda figure: draw.draw_held_out(figure, held_out),
            )
        )
    else:
        text.append(
            f"The held-out prediction error was not computed{f': {why}' if (why := f.problems.get('held_out')) else ''}; "
            "--held-out does it, and takes several times as long."
        )
    if f.reference_errors:
        rows = [
            (
                *format_cells(name, (e.compared, 0), (e.position_rms_mm, 1), (e.centroid.position_rms_mm, 1)),
                format_number(e.orientation_rms_deg, 3),
                format_number(e.nees.mean),
                "-" if math.isnan(e.nees.above_95) else f"{e.nees.above_95:.1%}",
            )
            for name, e in f.reference_errors.items()
        ]
        columns = (
            "estimator|poses|rms (mm)|centroid (mm)|rms (deg)|NEES (expected 6)|above 95 % (expected 5 %)"
        )
        caption = f"Against the reference, unaligned, at {at} and at the prisms' centroid"
        tables.append(_table(caption, columns, rows))
        tables += reference_tables(f)
        if f.reference is not None and not any(e.compared for e in f.reference_errors.values()):
            text.append(
                f"The reference does not overlap with valid poses in time: it covers {format_utc(int(f.reference.stamp_ns[0]))} to "
                f"{format_utc(int(f.reference.stamp_ns[-1]))}, the recording {format_utc(f.start_ns)} to {format_utc(f.end_ns)} "
                "(all UTC); 2 s at both ends are excluded."
            )
    if f.difference is not None and len(f.difference.stamp_ns):
        difference = f.difference
        numbers = difference_numbers(difference)
        mm, deg = numbers["position_mm"], numbers["rotation_deg"]
        centroid_mm = numbers["centroid"]["position_mm"]
        text.append(
            f"Where both are valid ({numbers['epochs']} epochs), they differ at {at} by {mm['median']:.1f} mm and "
            f"{deg['median']:.2f} degrees (median), {mm['p95']:.1f} mm and {deg['p95']:.2f} degrees (95 %); at the prisms' "
            f"centroid by {centroid_mm['median']:.1f} mm (median) and {centroid_mm['p95']:.1f} mm (95 %)."
        )
        plots.append(
            page_figure(
                "estimators_apart",
                f"Difference between the poses of linear and continuous, position at {at}.",
                panels_height_mm(2),
                lambda figure: draw.draw_difference(figure, difference, axis),
            )
        )
    return Section("Both estimators", tuple(text), tuple(tables), tuple(plots))


def _poses_of(f: Findings) -> Table:
    rows = []
    for name, poses in f.poses_by_estimator.items():
        numbers = pose_numbers(poses, f.recording.parameters)
        sigma, centroid = numbers["position_sigma_mm"], numbers["centroid"]["position_sigma_mm"]
        reasons = ", ".join(f"{reason} {n}" for reason, n in numbers["invalid"].items()) or "-"
        counts = format_cells(name, (numbers["poses"], 0), (numbers["valid_poses"], 0))
        sigmas = (sigma["median"], sigma["p95"], centroid["median"])
        rows.append((*counts, *format_cells(reasons, *((each, 1) for each in sigmas))))
    columns = "estimator|poses|valid|not valid|median sigma (mm)|95 % sigma (mm)|centroid median sigma (mm)"
    at = point_label(f.recording.parameters.reference_point)
    return _table(
        f"Poses, and the stated position sigma per axis of the valid ones at {at}, with that at the prisms' centroid",
        columns,
        rows,
    )


def trajectory_section(f: Findings, axis: TimeAxis) -> Section:
    """Return the section on the trajectory."""
    poses = f.poses
    if poses is None:
        return Section("Trajectory", ("There are no poses.",))
    at = point_label(poses.reference_point)
    estimator = "smoothed (continuous)" if poses.kind[0] == Kind.SMOOTHED else "interpolated (linear)"
    stations = {
        s.station: np.array(s.T_station1_station)[:3, 3]
        for s in f.recording.parameters.stations
        if any(isinstance(m, PolarMeasurement) and m.station == s.station for m in f.recording.measurements)
    }
    plots = (
        page_figure(
            "map",
            f"Path of {at} from above.",
            110.0,
            lambda figure: draw.draw_map(figure, poses, stations),
        ),
        page_figure(
            "trajectory",
            f"Position of {at} in frame station1 over time, and the stated sigmas of position and rotation "
            "(median and 5th to 95th percentile). Lines are interrupted where no pose is valid.",
            panels_height_mm(5),
            lambda figure: draw.draw_coordinates(figure, poses, axis),
        ),
    )
    return Section("Trajectory", (f"Poses of {at}, {estimator}.",), plots=plots)


def residual_section(f: Findings, axis: TimeAxis) -> Section:
    """Return the section on the residuals of the continuous trajectory."""
    if f.continuous is None:
        return Section("Residuals", ("Unknown without the continuous trajectory.",))
    rows = [
        (
            f"{station} {axis.replace('_', ' ')}",
            str(e.n),
            format_number(e.mean, 2),
            format_number(e.std, 2),
            f"{e.beyond_3_sigma:.2%}",
        )
        for station, axes in f.residuals.items()
        for axis, e in axes.items()
    ]
    tables = [
        Table(
            "Normalised residuals of the continuous trajectory (expected: 0, 1, 0.27 %)",
            ("station", "n", "mean", "std", "beyond 3"),
            tuple(rows),
        )
    ]
    if f.outliers:
        listed = [
            (
                format_utc(o.stamp_ns),
                str(o.station),
                str(o.prism),
                format_number(o.missed_mm),
                format_number(o.sigmas),
            )
            for o in f.outliers[:MAX_LISTED]
        ]
        more = f"; the {MAX_LISTED} worst of {len(f.outliers)}" if len(f.outliers) > MAX_LISTED else ""
        tables.append(
            Table(
                f"Rejected outliers{more}",
                ("time (UTC)", "station", "prism", "mm", "sigmas"),
                tuple(listed),
            )
        )
    sources = f.continuous.sources
    stamps = np.array([m.stamp_ns for m in sources], dtype=np.int64)
    numbers = np.array([m.station for m in sources], dtype=np.int64)
    plot = page_figure(
        "residuals",
        "Residuals over time in sigmas: trajectory minus measurement. A constant offset indicates an error of a frame, a "
        "constant or a latency; a drifting one a tripod that moved. Dashed: 3 sigmas; values beyond 6 are drawn at the edge.",
        panels_height_mm(len(np.unique(numbers))),
        lambda figure: draw.draw_residuals(figure, f.normalised, stamps, numbers, axis),
    )
    motion = f.continuous.motion
    text = (
        f"The noise of the measurements is {motion.noise_scale:.2f} times the stated noise of the instruments"
        + ("." if motion.tuned else ", as recorded: there are too few measurements to estimate it."),
    )
    return Section("Residuals", text, tuple(tables), (plot,))


def perturbation_section(f: Findings) -> Section:
    """Return the section on the effect of prism noise on a pose."""
    title = "Effect of prism noise on a pose"
    noise = f.pose_noise
    if noise is None:
        return Section(title, (f"Unknown: {f.problems['pose_noise']}.",))
    text: tuple[str, ...] = ()
    if noise.as_measured is not None:
        m = noise.as_measured
        text = (
            (
                f"The measured mean inter-prism error of {1e3 * m.inter_prism_mean_m:.1f} mm corresponds to white noise on the "
                f"prisms of {1e3 * m.noise_m:.1f} mm per axis. With this layout, that causes errors of "
                f"{1e3 * m.position_norm_mean_m:.1f} mm in position (mean of the norm, at the prisms' centroid) and "
                f"{m.rotation_norm_mean_rad:.4f} rad ({math.degrees(m.rotation_norm_mean_rad):.2f} degrees) in rotation, for "
                "a pose from one measurement of each prism."
            ),
        )

    def write(paths: Sequence[Path]) -> None:
        draw_perturbation(noise.study, noise.first_order_per_mm, paths)

    caption = (
        "Pose errors over noise on the prisms, for this layout, positions at the prisms' centroid: mean and standard deviation "
        "per axis, and of the norm. "
        "Dotted: first-order propagation."
    )
    return Section(title, text, plots=(ReportFigure("perturbation", caption, write),))
