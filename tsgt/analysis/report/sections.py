"""Report sections on stations, clocks and inter-prism distances, and the list of all sections."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import binned, gridded
from tsgt.analysis.figures import TimeAxis, panels_height_mm
from tsgt.analysis.refinement import refinement_rows, refinement_text
from tsgt.analysis.report import station_figures as draw
from tsgt.analysis.report.calibration import calibration_section
from tsgt.analysis.report.diagnosis_section import diagnosis_section
from tsgt.analysis.report.imu_section import imu_section
from tsgt.analysis.report.live_section import live_section
from tsgt.analysis.report.page import (
    MAX_LISTED,
    UNKNOWN,
    ReportFigure,
    Section,
    Table,
    format_number,
    format_utc,
    nan_median,
)
from tsgt.analysis.report.pose_sections import estimator_section, perturbation_section, residual_section
from tsgt.analysis.report.trajectory_sections import pose_section, reference_section

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.evaluation import PairDistances
    from tsgt.analysis.report.findings import Findings
    from tsgt.analysis.report.motion import RobotMotion
    from tsgt.geometry import FloatArray


def sections(f: Findings) -> list[Section]:
    """Return all sections in their order: those that help most to decide come first."""
    axis = TimeAxis.over(f.start_ns, f.end_ns)
    found = (
        diagnosis_section(f.diagnosis, f.problems.get("diagnosis"), *_refinement(f)),
        reference_section(f, axis),
        pose_section(f, axis),
        live_section(f.live, f.point),
        estimator_section(f, axis),
        imu_section(f, axis),
        _distances(f, axis),
        residual_section(f, axis),
        calibration_section(f.recording),
        _stations(f, axis),
        _clocks(f, axis),
        _by_motion(f),
        perturbation_section(f),
        _recording(f),
    )
    return [section for section in found if section is not None]


def _refinement(f: Findings) -> tuple[str, tuple[tuple[str, ...], ...]]:
    """Return what of the set-up was refined within the trajectory, in words and as rows of a table."""
    if f.continuous is None:
        return "", ()
    refined, parameters = f.continuous.refinement, f.continuous.parameters
    return f"{refinement_text(refined, parameters)}.", refinement_rows(refined, parameters)


def _recording(f: Findings) -> Section:
    """Return the facts about the recording."""
    parameters = f.recording.parameters
    rows = [
        ("file", f.path.name),
        ("written by", f"{f.recording.header.software}, {f.recording.header.source}"),
        ("first measurement", f"{format_utc(f.start_ns)} UTC"),
        ("duration", f"{f.duration_s:.1f} s"),
        ("stations, prisms", f"{len(parameters.stations)}, {len(parameters.prisms)}"),
        ("measurements", f"{sum(e.measurements for e in f.station_statistics.values())}"),
        ("radio protocol", f.log.protocol or UNKNOWN),
        *([] if f.log.imu is None else [("IMU", ", ".join([f.log.imu.device, *f.log.imu.figures()]))]),
        *(
            []
            if f.log.odometry is None
            else [("wheel odometry", ", ".join([f.log.odometry.device, *f.log.odometry.figures()]))]
        ),
        ("events recorded", f"{len(f.log.events)}"),
    ]
    tables = [Table("", (), tuple(rows))]
    if f.log.events:
        listed = [(format_utc(stamp_ns), message) for stamp_ns, message in f.log.events[:MAX_LISTED]]
        more = f", the first {MAX_LISTED} of {len(f.log.events)}" if len(f.log.events) > MAX_LISTED else ""
        tables.append(Table(f"Events{more}", ("time (UTC)", "event"), tuple(listed)))
    return Section("About this recording", tables=tuple(tables))


def _stations(f: Findings, axis: TimeAxis) -> Section:
    outage_limit_s = f.recording.parameters.pipeline.outage_limit_ns / 1e9
    columns: dict[str, list[str]] = {
        name: [] for name in (
            "station", "prisms", "measured", "usable", "per second", "longest gap (s)",
            f"gaps over {outage_limit_s:g} s (of the time)", "distance (m)", "delay median / 95 % (s)",
            "signal RSSI (dBm)", "signal to noise (dB)", "radio loss (%)",
        )
    }  # fmt: skip
    for record in f.station_records:
        each = f.station_statistics[record.station]
        series = f.log.radio.get(record.station)
        cells = (
            str(record.station),
            ", ".join(map(str, record.prisms)) or "none",
            str(each.measurements),
            str(each.usable),
            format_number(each.rate_hz, 2),
            format_number(each.longest_gap_s, 2),
            f"{each.gaps} ({each.in_gaps:.1%})",
            _pair(each.distance_min_m, " to ", each.distance_max_m, 0),
            _pair(each.delay_median_s, " / ", each.delay_p95_s, 2),
            format_number(nan_median(None if series is None else series.rssi_dbm), 0),
            format_number(nan_median(None if series is None else series.snr_db), 1),
            format_number(nan_median(None if series is None else 100 * series.loss), 1),
        )
        for column, cell in zip(columns.values(), cells, strict=True):
            column.append(cell)
    unknown = [name for name, cells in columns.items() if all(cell == UNKNOWN for cell in cells)]
    shown = {name: cells for name, cells in columns.items() if name not in unknown}
    text = [f"Unknown, because it was not recorded: {', '.join(unknown)}."] if unknown else []
    caption = "Measurements of the stations; median of the radio's figures; delay from a measurement to its arrival at the master"
    table = Table(caption, tuple(shown), tuple(zip(*shown.values(), strict=True)))
    n = len(f.station_records)
    plots = [
        ReportFigure(
            "gaps",
            "Gaps between the measurements of each station",
            "Each point is a usable measurement; its height is the time since the previous one. Points in one line near the "
            "bottom are good; gaps above the dotted line make poses invalid. Crosses: measurements that the instrument could "
            "not make. Diamonds: the station began later, or ended earlier, than the others.",
            panels_height_mm(n),
            lambda figure: draw.draw_gaps(figure, f.station_records, axis, outage_limit_s, f.end_ns),
        )
    ]
    if any(len(s.statuses) > 1 for s in f.station_records):
        plots.append(
            ReportFigure(
                "statuses",
                "What the instruments reported about their measurements",
                "`low_accuracy` is normal while the robot moves.",
                24.0 + 9.0 * n,
                lambda figure: draw.draw_statuses(figure, f.station_records),
            )
        )
    radio = {k: v for k, v in f.log.radio.items() if np.isfinite(v.rssi_dbm).any()}
    if radio:
        plots.append(
            ReportFigure(
                "radio",
                "Radio reception of each station",
                "Strength of the signal (RSSI), ratio of signal to noise (SNR), and lost requests. Losses at a low ratio indicate "
                "distance or antennas, losses at a high one collisions or an overloaded computer.",
                panels_height_mm(3),
                lambda figure: draw.draw_radio(figure, radio, axis),
            )
        )
    return Section("Stations and radio", tuple(text), (table,), tuple(plots))


def _pair(first: float, sign: str, second: float, digits: int) -> str:
    """Format two numbers that are known together."""
    return f"{first:.{digits}f}{sign}{second:.{digits}f}" if math.isfinite(first + second) else UNKNOWN


def _clocks(f: Findings, axis: TimeAxis) -> Section:
    bounded = any(np.isfinite(s.bound_ns).any() for s in f.station_records)
    if not bounded and not f.log.clocks:
        return Section(
            "Clocks of the stations",
            ("Unknown: the recording contains neither synchronisations nor bounds of the time errors.",),
        )
    text = []
    if not f.log.clocks:
        text.append(
            "No synchronisations were recorded. The protocol superframe has none: times of measurements are relative to the "
            "master's beacons, and the bounds below include that."
        )
    caption = (
        "Top, if recorded: offset of the station's clock from the master's (positive: station ahead), with its bound. "
        "Below: bound of the time error of each measurement. At 1 m/s, a millisecond moves a prism by a millimetre."
    )
    rows = bool(f.log.clocks) + sum(bool(np.isfinite(s.bound_ns).any()) for s in f.station_records)
    plot = ReportFigure(
        "clocks",
        "Time errors of the measurements",
        caption,
        panels_height_mm(rows) + 8 * rows,
        lambda figure: draw.draw_clocks(figure, f.log.clocks, f.station_records, axis),
    )
    return Section("Clocks of the stations", tuple(text), plots=(plot,))


def _distances(f: Findings, axis: TimeAxis) -> Section:
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


def _by_motion(f: Findings) -> Section:
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
