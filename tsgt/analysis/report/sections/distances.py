"""Report sections on the distances between prisms, over time and by the motion of the robot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import binned, gridded
from tsgt.analysis.figures import panels_height_mm
from tsgt.analysis.report.figures import stations as draw
from tsgt.analysis.report.page import ReportFigure, Section, Table, format_number, format_utc

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.evaluation import PairDistances
    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.report.findings import Findings
    from tsgt.analysis.report.motion import RobotMotion
    from tsgt.geometry import FloatArray


def distance_section(f: Findings, axis: TimeAxis) -> Section:
    """Return the distances between prisms, at rest and in motion, against those of the layout."""
    title = "Distances between prisms"
    if f.inter_prism is None or f.distance_errors is None:
        return Section(title, (f"Unknown: {f.problems['inter_prism']}.",))
    found, errors = f.inter_prism, f.distance_errors
    if not found.epochs:
        return Section(title, ("The tracks of the prisms do not overlap in time.",))
    text = [
        (
            f"At {found.epochs - found.invalid_epochs} of {found.epochs} instants (20 per second) all prisms were measured without a "
            "gap. The robot was "
            f"stationary for {found.stationary_s:.1f} s in {len(found.stationary_ns)} intervals (shaded below). A robot is rigid: "
            "each distance should always be that of the prism layout."
        )
    ]
    if not found.stationary_ns:
        text.append(
            "The robot never stood still for 3 s or more, so there are no distances of a stationary robot."
        )
    if f.odometry_stationary_ns and not found.stationary_ns:
        text.append(
            f"According to the odometry the robot was stationary from {format_utc(f.odometry_stationary_ns[0][0])} to "
            f"{format_utc(f.odometry_stationary_ns[-1][1])} UTC, before or after this recording: check that the odometry is of "
            "this drive, and both clocks."
        )
    if not np.isfinite(errors.motion.speed_mps).any():
        text.append("Speed and angular rate are unknown, since there are no poses.")
    header = (
        "prisms", "number", "layout (mm)", "mean (mm)", "standard deviation (mm)", "mean error (mm)", "95 % error (mm)",
    )  # fmt: skip
    tables = (
        Table(
            "Distances while the robot stood still, measurements as they are", header, _pairs(found.static)
        ),
        Table("Distances at all times, interpolated between measurements", header, _pairs(found.dynamic)),
    )
    height_mm = panels_height_mm(len(errors.error_m) + 2)
    plots = (
        ReportFigure(
            "distances",
            "Errors of the distances between prisms",
            "Measured distance minus that of the layout (solid line: 0; dashed: mean). While the robot stands still, a mean other "
            "than 0 indicates an error of the prism layout, a station frame or a prism constant; the width is the instruments' "
            "noise. Values beyond the axis count in the outermost bins.",
            90.0,
            lambda figure: draw.draw_histograms(figure, found),
        ),
        ReportFigure(
            "distances_over_time",
            "Errors of the distances between prisms over time",
            "With speed and angular rate of the robot; grey: it stood still. An error proportional to the speed indicates a time "
            "offset; peaks at starts and stops are due to linear interpolation between measurements.",
            height_mm,
            lambda figure: draw.draw_distance_errors(figure, errors, found.stationary_ns, axis),
        ),
    )
    return Section(title, tuple(text), tables, plots)


def motion_section(f: Findings) -> Section:
    """Return the errors of these distances by speed, acceleration and angular rate."""
    title = "Errors of the distances by the motion of the robot"
    errors = f.distance_errors
    if errors is None or not np.isfinite(errors.motion.speed_mps).any():
        return Section(title, ("Unknown: requires the distances between all prisms, and poses.",))
    error_m = np.array(list(errors.error_m.values()))
    motion = errors.motion
    names = ("speed\n(m/s)", "acceleration\n(m/s²)", "angular rate\n(rad/s)")
    values = (motion.speed_mps, motion.acceleration_mps2, motion.angular_rate_radps)
    bins = [(name, binned(error_m, value)) for name, value in zip(names, values, strict=True)]
    if all(found is None for _, found in bins):
        return Section(title, ("There are too few distances, or the robot did not move.",))
    plots = [
        ReportFigure(
            "errors_by_motion",
            "Errors of the distances by speed, acceleration and angular rate",
            "Errors of all pairs by the motion of the robot; below, their number (the outermost bins include "
            "values beyond them). Acceleration is the derivative of the speed: negative while braking.",
            75.0,
            lambda figure: draw.draw_bins(figure, bins),
        )
    ]
    plots += _grids(error_m, motion, names)
    return Section(title, plots=tuple(plots))


def _grids(error_m: FloatArray, motion: RobotMotion, names: tuple[str, str, str]) -> list[ReportFigure]:
    found = [
        (name, names[2], grid)
        for name, x in ((names[0], motion.speed_mps), (names[1], motion.acceleration_mps2))
        if (grid := gridded(error_m, x, motion.angular_rate_radps)) is not None
    ]
    if not found:
        return []
    caption = (
        "Mean error in mm. Cells with fewer than 20 distances are empty; the outermost ones include "
        "values beyond them."
    )
    title = "Errors of the distances by two quantities at a time"
    return [
        ReportFigure("errors_by_two", title, caption, 80.0, lambda figure: draw.draw_grids(figure, found))
    ]


def _pairs(pairs: Sequence[PairDistances]) -> tuple[tuple[str, ...], ...]:
    return tuple(
        (pair.name, str(s.valid), *map(format_number, (s.reference, s.mean, s.std, s.mean_abs_error, s.p95)))
        for pair in pairs
        for s in (pair.statistics(),)
    )
