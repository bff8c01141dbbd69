"""Report sections on the estimators: held-out prediction, residuals, and the effect of prism noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import PREDICTOR_NAMES, noise_scales_by_axis
from tsgt.analysis.figures import panels_height_mm
from tsgt.analysis.report.figures import poses as draw
from tsgt.analysis.report.numbers import difference_numbers, perturbation_numbers, pose_numbers
from tsgt.analysis.report.page import (
    MAX_LISTED,
    ReportFigure,
    Section,
    Table,
    format_cells,
    format_number,
    format_share,
    format_utc,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.analysis.evaluation import HeldOutErrors, Predictor
    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.report.findings import Findings

_COMPONENTS = {"range": "distance", "horizontal_angle": "horizontal angle", "zenith_angle": "zenith angle"}


def estimator_section(f: Findings, axis: TimeAxis) -> Section:
    """Return the section that compares both estimators."""
    text = [
        f"The estimator {name} yields no poses: {f.problems[name]}."
        for name in ("linear", "continuous")
        if name in f.problems
    ]
    tables, plots = [], []
    if f.held_out is not None:
        text.append(
            "Measurements were held out in folds, of one prism at a time, and predicted from the remaining ones by each estimator. "
            "The difference between prediction and measurement contains the noise of the measurement."
        )
        rows = [
            format_cells(label, (m.n, 0), (m.mean, 1), (m.median, 1), (m.p95, 1))
            for name, each in f.held_out.items()
            for label, m in (
                (PREDICTOR_NAMES[name], each.statistics),
                (f"{PREDICTOR_NAMES[name]}, at gaps over 1 s", each.gaps),
            )
            if m.n
        ]
        header = ("estimator", "measurements", "mean", "median", "95 %")
        tables.append(
            Table(
                "Held-out prediction error of prism positions (mm)",
                header,
                tuple(rows),
            )
        )
        tables.append(_normalised_table(f.held_out))
        held_out = f.held_out
        plots.append(
            ReportFigure(
                "held_out",
                "Prediction error of held-out measurements",
                "Share of the held-out measurements that are predicted better than the error on the axis: a curve further up "
                "and left is better.",
                65.0,
                lambda figure: draw.draw_held_out(figure, held_out),
            )
        )
    else:
        why = f.problems.get("held_out")
        text.append(
            f"How well held-out measurements are predicted was not computed{f': {why}' if why else ''}; `--held-out` does it, "
            "and takes several times as long."
        )
    if f.poses_by_estimator:
        tables.append(_poses_of(f))
    if f.difference is not None and len(f.difference.stamp_ns):
        difference = f.difference
        numbers = difference_numbers(difference)
        mm, deg = numbers["position_mm"], numbers["rotation_deg"]
        centroid_mm = numbers["centroid"]["position_mm"]
        text.append(
            f"Where the poses of both estimators are valid ({numbers['epochs']} epochs), they differ at {f.point} by "
            f"{mm['median']:.1f} mm and {deg['median']:.2f} degrees (median), {mm['p95']:.1f} mm and {deg['p95']:.2f} degrees "
            f"(95 %); at the prisms' centroid by {centroid_mm['median']:.1f} mm (median) and {centroid_mm['p95']:.1f} mm (95 %)."
        )
        plots.append(
            ReportFigure(
                "estimators_apart",
                "Difference between the poses of both estimators",
                f"Distance between the two positions of {f.point}, and angle between the two rotations. It is not an error, but "
                "where it is large one of them is wrong.",
                panels_height_mm(2),
                lambda figure: draw.draw_difference(figure, difference, axis, f.point),
            )
        )
    return Section(
        "Both estimators, and prediction of held-out measurements", tuple(text), tuple(tables), tuple(plots)
    )


def _normalised_table(held_out: Mapping[Predictor, HeldOutErrors]) -> Table:
    rows = [
        format_cells(
            f"{PREDICTOR_NAMES[name]}, {part}, {_COMPONENTS.get(component, component)}",
            (m.n, 0),
            (m.rms, 2),
            (m.robust, 2),
            (100.0 * m.beyond_3_29_sigma, 1),
        )
        for name, each in held_out.items()
        for part, components in each.normalised_statistics().items()
        if part in ("moving", "stationary")
        for component, m in components.items()
    ]
    return Table(
        "The same errors in the sigmas that covariance and noise state: rms 1 and 0.1 % beyond 3.29 where these are right",
        ("estimator, part, component", "measurements", "rms", "rms by median", "beyond 3.29 (%)"),
        tuple(rows),
    )


def _poses_of(f: Findings) -> Table:
    rows = []
    for name, poses in f.poses_by_estimator.items():
        numbers = pose_numbers(poses, f.recording.parameters)
        position, rotation = numbers["position_sigma_mm"], numbers["rotation_sigma_deg"]
        reasons = ", ".join(f"{reason} {n}" for reason, n in numbers["invalid"].items()) or "none"
        counts = format_cells(name, (numbers["poses"], 0), (numbers["valid_poses"], 0))
        sigmas = (
            *(
                (position["median"], 1),
                (position["p95"], 1),
                (numbers["centroid"]["position_sigma_mm"]["median"], 1),
            ),
            *((rotation["median"], 3), (rotation["p95"], 3)),
        )
        rows.append((*counts, *format_cells(reasons, *sigmas)))
    header = (
        *("estimator", "poses", "valid", "not valid", "median (mm)", "95 % (mm)", "centroid median (mm)"),
        *("median (deg)", "95 % (deg)"),
    )
    caption = (
        f"Stated standard deviation per axis of the valid poses: position of {f.point}, beside it at the prisms' centroid (mm), and "
        "rotation (deg)"
    )
    return Table(caption, header, tuple(rows))


def residual_section(f: Findings, axis: TimeAxis) -> Section:
    """Return the section on the residuals of the continuous trajectory."""
    title = "How well the measurements fit the trajectory"
    if f.continuous is None:
        return Section(title, ("Unknown without the continuous trajectory.",))
    motion = f.continuous.motion
    text = (
        f"The trajectory was fitted with {motion.noise_scale:.2f} times the stated noise of the instruments"
        + (
            "; by station and component in the table. Errors of the set-up count as noise here."
            if motion.tuned or f.continuous.imu is not None
            else ", as recorded: there are too few measurements to estimate it."
        ),
    )
    factors = noise_scales_by_axis(f.continuous.fit.observations, motion.noise_scales, f.continuous.sources)
    rows = [
        (
            f"{station} {_COMPONENTS.get(component, component.replace('_', ' '))}",
            str(e.n),
            format_number(e.mean, 2),
            format_number(e.std, 2),
            format_share(e.beyond_3_sigma, 2),
            format_number(factors[station][component], 2),
        )
        for station, components in f.residuals.items()
        for component, e in components.items()
    ]
    tables = [
        Table(
            "Difference between measurement and trajectory, divided by its expected standard deviation (expected: mean 0, "
            "standard deviation 1, 0.27 % beyond 3)",
            ("station", "measurements", "mean", "standard deviation", "beyond 3", "noise / stated noise"),
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
                f"Measurements that were rejected because they are far from the trajectory{more}",
                ("time (UTC)", "station", "prism", "distance (mm)", "in standard deviations"),
                tuple(listed),
            )
        )
    sources = f.continuous.sources
    stamps = np.array([m.stamp_ns for m in sources], dtype=np.int64)
    numbers = np.array([m.station for m in sources], dtype=np.int64)
    plot = ReportFigure(
        "residuals",
        "Difference between measurement and trajectory over time",
        "In standard deviations: trajectory minus measurement. An offset that stays indicates an error of a station frame, a "
        "prism constant or a latency; one that drifts, a tripod that moved. Dashed: 3 standard deviations; values beyond 6 are "
        "drawn at the edge.",
        panels_height_mm(len(np.unique(numbers))),
        lambda figure: draw.draw_residuals(figure, f.normalised, stamps, numbers, axis),
    )
    return Section(title, text, tuple(tables), (plot,))


def perturbation_section(f: Findings) -> Section:
    """Return the section on the effect of prism noise on a pose."""
    title = "What noise on the prisms does to a pose"
    noise = f.pose_noise
    if noise is None:
        return Section(title, (f"Unknown: {f.problems['pose_noise']}.",))
    numbers = perturbation_numbers(noise)
    text = (
        f"The measured distances between the prisms are wrong by {numbers['inter_prism_mean_mm']:.1f} mm on average. White noise "
        f"of {numbers['noise_mm']:.1f} mm (1 sigma) on each coordinate of each prism would cause that. With this prism layout, "
        "such noise causes the errors below in a pose that is computed from one measurement of each prism."
    )
    rows = [
        format_cells(
            name, *((value, 1) for value in (*numbers["position_std_mm"], numbers["position_norm_mean_mm"]))
        )
        for name in ("position (mm)",)
    ] + [
        format_cells(
            name, *((value, 3) for value in (*numbers["rotation_std_deg"], numbers["rotation_norm_mean_deg"]))
        )
        for name in ("rotation (deg)",)
    ]
    table = Table(
        "Standard deviation (1 sigma) along or about the robot's axes, and mean length or angle; position of the "
        "prisms' centroid",
        ("error", "x", "y", "z", "mean length or angle"),
        tuple(rows),
    )
    plot = ReportFigure(
        "perturbation",
        "Pose error over the noise of the prisms",
        "Standard deviation along or about each axis of the robot, and mean length or angle, of the error of the prisms' "
        "centroid and of the rotation. Dotted vertical line: the noise that explains the measured distances.",
        60.0,
        lambda figure: draw.draw_perturbation(figure, noise.study, noise.as_measured.noise_m),
    )
    return Section(title, (text,), (table,), (plot,))
