"""The sections of a report on poses: both estimators, the trajectory, residuals, what noise means.

Tables of a report on the reference, besides the unaligned errors: what an alignment hides, and the stops. Pure.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import draw_perturbation, panels_height_mm
from tsgt.analysis.report import pose_figures as draw
from tsgt.analysis.report.elements import LISTED, number, utc, wide
from tsgt.analysis.report.numbers import apart, of_poses
from tsgt.analysis.report.page import ReportFigure, Section, Table
from tsgt.estimation import Kind
from tsgt.model import PolarMeasurement

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.report.findings import Findings


def reference_tables(f: Findings) -> list[Table]:
    """Make a table of the aligned errors if they were asked for, and one of the stops if there are any."""
    tables = []
    if f.aligned:
        rows = [
            (
                name,
                number(a.position_rms_mm),
                number(a.orientation_rms_deg, 3),
                number(a.translation_mm),
                number(a.rotation_deg, 3),
                number(a.hidden_position_mm),
                number(a.hidden_orientation_deg, 3),
            )
            for name, a in f.aligned.items()
        ]
        header = (
            *("estimator", "rms (mm)", "rms (deg)", "shifted (mm)", "turned (deg)"),
            *("hides (mm)", "hides (deg)"),
        )
        tables.append(
            Table(
                "The same aligned: what is left, what was removed, and how much of the rms that hides",
                header,
                tuple(rows),
            )
        )
    stops = [
        (
            name,
            str(s.stops),
            number(s.position_mean_mm, 2),
            number(s.position_max_mm, 2),
            number(s.rotation_mean_deg, 3),
            number(s.rotation_max_deg, 3),
        )
        for name, s in f.stops.items()
        if s.stops
    ]
    if stops:
        tables.append(
            Table(
                "The mean pose of each stop against the reference, unaligned",
                ("estimator", "stops", "mean (mm)", "largest (mm)", "mean (deg)", "largest (deg)"),
                tuple(stops),
            )
        )
    return tables


def estimators(f: Findings, clock: TimeAxis) -> Section:
    """Tell how well both estimators do."""
    text = [
        f"The estimator {name} gives no poses: {f.problems[name]}."
        for name in ("linear", "continuous")
        if name in f.problems
    ]
    tables, plots = [], []
    if f.both:
        tables.append(_poses_of(f))
    if f.held_out is not None:
        rows = [
            (label, str(m.n), number(m.mean), number(m.median), number(m.p95))
            for name, each in f.held_out.items()
            for label, m in ((name, each.statistics), (f"{name}, at gaps over 1 s", each.gaps))
        ]
        tables.append(
            Table(
                "Measurements left out and predicted from the rest, missed by (mm)",
                ("estimator", "n", "mean", "median", "95 %"),
                tuple(rows),
            )
        )
        misses = f.held_out
        plots.append(
            wide(
                "held_out",
                "Share of the left-out measurements that each estimator missed by less than so much, the measurements' own "
                "noise included: further up and left is better.",
                65.0,
                lambda figure: draw.draw_held_out(figure, misses),
            )
        )
    else:
        text.append(
            f"No measurements were left out and predicted{f': {why}' if (why := f.problems.get('held_out')) else ''}; "
            "--held-out does it, and takes several times as long."
        )
    if f.compared:
        compared = [
            (
                name,
                str(e.compared),
                number(e.position_rms_mm),
                number(e.orientation_rms_deg, 3),
                number(e.nees.mean),
                "-" if math.isnan(e.nees.above_95) else f"{e.nees.above_95:.1%}",
            )
            for name, e in f.compared.items()
        ]
        header = (
            "estimator",
            "poses",
            "rms (mm)",
            "rms (deg)",
            "NEES (6 is right)",
            "above 95 % (5 % is right)",
        )
        tables.append(
            Table("Against the reference, unaligned, at the prisms' centroid", header, tuple(compared))
        )
        tables += reference_tables(f)
        if f.reference is not None and not any(e.compared for e in f.compared.values()):
            text.append(
                f"The reference has no time in common with valid poses: it goes from {utc(int(f.reference.stamp_ns[0]))} to "
                f"{utc(int(f.reference.stamp_ns[-1]))}, the recording from {utc(f.start_ns)} to {utc(f.end_ns)} "
                "(all UTC); 2 s at both ends do not count."
            )
    if f.difference is not None and len(f.difference.stamp_ns):
        difference = f.difference
        told = apart(difference)
        mm, deg = told["position_mm"], told["rotation_deg"]
        text.append(
            f"Where both are valid ({told['epochs']} epochs), they are {mm['median']:.1f} mm and {deg['median']:.2f} degrees "
            f"apart (median), {mm['p95']:.1f} mm and {deg['p95']:.2f} degrees (95 %)."
        )
        plots.append(
            wide(
                "estimators_apart",
                "How far the poses of linear and continuous are apart, position at the prisms' centroid.",
                panels_height_mm(2),
                lambda figure: draw.draw_difference(figure, difference, clock),
            )
        )
    return Section("Both estimators", tuple(text), tuple(tables), tuple(plots))


def _poses_of(f: Findings) -> Table:
    rows = []
    for name, poses in f.both.items():
        told = of_poses(poses)
        sigma = told["position_sigma_mm"]
        why = ", ".join(f"{reason} {n}" for reason, n in told["invalid"].items()) or "-"
        counts = str(told["poses"]), str(told["valid_poses"]), why
        rows.append((name, *counts, number(sigma["median"]), number(sigma["p95"])))
    return Table(
        "Poses, and the sigma per axis of the position that the valid ones state",
        ("estimator", "poses", "valid", "not valid", "median sigma (mm)", "95 % sigma (mm)"),
        tuple(rows),
    )


def trajectory(f: Findings, clock: TimeAxis) -> Section:
    """Tell where the robot went."""
    poses = f.poses
    if poses is None:
        return Section("Trajectory", ("There are no poses.",))
    estimator = "smoothed (continuous)" if poses.kind[0] == Kind.SMOOTHED else "interpolated (linear)"
    stations = {
        s.station: np.array(s.T_station1_station)[:3, 3]
        for s in f.recording.parameters.stations
        if any(isinstance(m, PolarMeasurement) and m.station == s.station for m in f.recording.measurements)
    }
    plots = (
        wide(
            "map",
            "The way of the robot's origin from above.",
            110.0,
            lambda figure: draw.draw_map(figure, poses, stations),
        ),
        wide(
            "trajectory",
            "Position of the robot's origin in frame station1 over time, and the sigmas of position and rotation that the "
            "poses state (median, and a band that holds nine tenths). Lines are broken where no pose is valid.",
            panels_height_mm(5),
            lambda figure: draw.draw_coordinates(figure, poses, clock),
        ),
    )
    return Section("Trajectory", (f"Poses are {estimator}.",), plots=plots)


def residuals(f: Findings, clock: TimeAxis) -> Section:
    """Tell how far measurements are from the trajectory."""
    if f.continuous is None:
        return Section("Residuals", ("There are none without the continuous trajectory.",))
    rows = [
        (
            f"{station} {axis.replace('_', ' ')}",
            str(e.n),
            number(e.mean, 2),
            number(e.std, 2),
            f"{e.beyond_3_sigma:.2%}",
        )
        for station, axes in f.residuals.items()
        for axis, e in axes.items()
    ]
    tables = [
        Table(
            "Residuals of the continuous trajectory, in the sigmas that they should have (0, 1, 0.27 %)",
            ("station", "n", "mean", "std", "beyond 3"),
            tuple(rows),
        )
    ]
    if f.outliers:
        listed = [
            (utc(o.stamp_ns), str(o.station), str(o.prism), number(o.missed_mm), number(o.sigmas))
            for o in f.outliers[:LISTED]
        ]
        more = f"; the {LISTED} worst of {len(f.outliers)}" if len(f.outliers) > LISTED else ""
        tables.append(
            Table(
                f"Measurements that stray too far to be noise{more}",
                ("time (UTC)", "station", "prism", "mm", "sigmas"),
                tuple(listed),
            )
        )
    sources = f.continuous.sources
    stamps = np.array([m.stamp_ns for m in sources], dtype=np.int64)
    numbers = np.array([m.station for m in sources], dtype=np.int64)
    plot = wide(
        "residuals",
        "Residuals over time in sigmas: trajectory less measurement. A band off the middle is a frame, a constant or a "
        "latency; one that wanders is a tripod that moved. Dashed: 3 sigmas; what is beyond 6 stands at the edge.",
        panels_height_mm(len(np.unique(numbers))),
        lambda figure: draw.draw_residuals(figure, f.normalised, stamps, numbers, clock),
    )
    motion = f.continuous.motion
    found = f"The measurements scatter by {motion.noise_scale:.2f} times the noise that the parameters state for the instruments."
    taken = f"{motion.noise_scale:.2f} times the noise that the parameters state is taken as recorded: too few measurements to tell."
    text = (found if motion.tuned else taken,)
    return Section("Residuals", text, tuple(tables), (plot,))


def perturbation(f: Findings) -> Section:
    """Tell what noise on the prisms does to a pose."""
    title = "What noise means for a pose"
    noise = f.pose_noise
    if noise is None:
        return Section(title, (f"Not known: {f.problems['pose_noise']}.",))
    text: tuple[str, ...] = ()
    if noise.as_measured is not None:
        m = noise.as_measured
        text = (
            (
                f"With this layout, the measured mean error of {1e3 * m.inter_prism_mean_m:.1f} mm between prisms means, as white "
                f"noise on the prisms of {1e3 * m.noise_m:.1f} mm per axis, {1e3 * m.position_norm_mean_m:.1f} mm in position (mean "
                f"of the norm, at the centroid) and {m.rotation_norm_mean_rad:.4f} rad "
                f"({math.degrees(m.rotation_norm_mean_rad):.2f} degrees) in rotation, for a pose from one measurement of each prism."
            ),
        )

    def write(paths: Sequence[Path]) -> None:
        draw_perturbation(noise.study, noise.first_order_per_mm, paths)

    caption = (
        "Errors of the pose over noise on the prisms, for this layout: mean and spread per axis, and of the length. Dotted: "
        "what first-order propagation says."
    )
    return Section(title, text, plots=(ReportFigure("perturbation", caption, write),))
