"""Report sections on stations, clocks and inter-prism distances, and the list of all sections."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import TimeAxis, panels_height_mm
from tsgt.analysis.report import station_figures as draw
from tsgt.analysis.report.calibration import calibration_section
from tsgt.analysis.report.motion import binned, gridded
from tsgt.analysis.report.page import (
    MAX_LISTED,
    ReportFigure,
    Section,
    Table,
    format_number,
    format_utc,
    nan_median,
    page_figure,
)
from tsgt.analysis.report.pose_sections import (
    estimator_section,
    perturbation_section,
    residual_section,
    trajectory_section,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.evaluation import PairDistances
    from tsgt.analysis.report.findings import Findings
    from tsgt.analysis.report.motion import RobotMotion
    from tsgt.geometry import FloatArray


def sections(f: Findings) -> list[Section]:
    """Return all sections in their order."""
    axis = TimeAxis.over(f.start_ns, f.end_ns)
    return [
        _stations(f, axis),
        _clocks(f, axis),
        _distances(f, axis),
        _by_motion(f),
        estimator_section(f, axis),
        trajectory_section(f, axis),
        residual_section(f, axis),
        calibration_section(f.recording),
        perturbation_section(f),
    ]


def summary_table(f: Findings) -> Table:
    """Return the facts about the recording."""
    parameters, poses = f.recording.parameters, f.poses
    rows = [
        ("file", f.path.name),
        ("written by", f"{f.recording.header.software}, {f.recording.header.source}"),
        ("first measurement", f"{format_utc(f.start_ns)} UTC"),
        ("duration", f"{f.duration_s:.1f} s"),
        ("stations, prisms", f"{len(parameters.stations)}, {len(parameters.prisms)}"),
        ("measurements", f"{sum(e.measurements for e in f.station_statistics.values())}"),
        ("radio", f.log.protocol or "not recorded"),
        (
            "valid poses",
            "none" if poses is None else f"{np.count_nonzero(poses.valid)} of {len(poses)}",
        ),
        ("events recorded", f"{len(f.log.events)}"),
    ]
    return Table("", (), tuple(rows))


def _stations(f: Findings, axis: TimeAxis) -> Section:
    outage_limit_s = f.recording.parameters.pipeline.outage_limit_ns / 1e9
    rows = []
    for record in f.station_records:
        each = f.station_statistics[record.station]
        series = f.log.radio.get(record.station)
        rows.append(
            (
                str(record.station),
                ", ".join(map(str, record.prisms)) or "-",
                str(each.measurements),
                str(each.usable),
                format_number(each.rate_hz, 2),
                format_number(each.longest_gap_s, 2),
                f"{each.gaps} ({each.in_gaps:.1%})",
                f"{format_number(each.distance_min_m, 0)} to {format_number(each.distance_max_m, 0)}",
                f"{format_number(each.delay_median_s, 2)} / {format_number(each.delay_p95_s, 2)}",
                *(
                    format_number(nan_median(values), digits)
                    for values, digits in (
                        (None if series is None else series.rssi_dbm, 0),
                        (None if series is None else series.snr_db, 1),
                        (None if series is None else 100 * series.loss, 1),
                    )
                ),
            )
        )
    header = (
        "station", "prisms", "measured", "usable", "Hz", "longest gap (s)", f"gaps > {outage_limit_s:g} s (of the time)",
        "distance (m)", "delay median / 95 % (s)", "RSSI (dBm)", "SNR (dB)", "loss (%)",
    )  # fmt: skip
    n = len(f.station_records)
    plots = [
        page_figure(
            "gaps",
            "Time from the previous usable measurement to each usable one, and unusable measurements (crosses at the "
            "bottom). Regular points near the bottom are good; gaps above the dotted line make poses invalid. Diamonds: time "
            "from the first measurement of all stations to the first of this one, and from its last to the last of all.",
            panels_height_mm(n),
            lambda figure: draw.draw_gaps(figure, f.station_records, axis, outage_limit_s, f.end_ns),
        ),
        page_figure(
            "statuses",
            "Status of the measurements.",
            24.0 + 9.0 * n,
            lambda figure: draw.draw_statuses(figure, f.station_records),
        ),
    ]
    text = [] if f.log.radio else ["The recording contains no radio status: RSSI, SNR and loss are unknown."]
    radio = {k: v for k, v in f.log.radio.items() if np.isfinite(v.rssi_dbm).any()}
    if radio:
        plots.append(
            page_figure(
                "radio",
                "Reception of the stations by the master. Losses at a low SNR indicate distance or antennas; losses at "
                "a high SNR indicate collisions or an overloaded computer.",
                panels_height_mm(3),
                lambda figure: draw.draw_radio(figure, radio, axis),
            )
        )
    events: tuple[Table, ...] = ()
    if f.log.events:
        listed = [(format_utc(stamp_ns), message) for stamp_ns, message in f.log.events[:MAX_LISTED]]
        more = f", the first {MAX_LISTED} of {len(f.log.events)}" if len(f.log.events) > MAX_LISTED else ""
        events = (Table(f"Events{more}", ("time (UTC)", "event"), tuple(listed)),)
    caption = "Medians of RSSI, SNR and loss; the delay is from the measurement to its arrival."
    return Section("Stations", tuple(text), (Table(caption, header, tuple(rows)), *events), tuple(plots))


def _clocks(f: Findings, axis: TimeAxis) -> Section:
    bounded = any(np.isfinite(s.bound_ns).any() for s in f.station_records)
    if not bounded and not f.log.clocks:
        return Section(
            "Clocks",
            ("The recording contains neither synchronisations nor timestamp bounds.",),
        )
    text = []
    if not f.log.clocks:
        text.append(
            "No synchronisations were recorded. The protocol superframe has none: times of measurements are relative to "
            "beacons, and the bounds below include that."
        )
    caption = (
        "Top, if recorded: offset of the station's clock from the master's (positive: station ahead), with its bound. "
        "Below: bound of the time error of each measurement. A millisecond is a millimetre at 1 m/s."
    )
    rows = bool(f.log.clocks) + sum(bool(np.isfinite(s.bound_ns).any()) for s in f.station_records)
    plot = page_figure(
        "clocks",
        caption,
        panels_height_mm(rows) + 8 * rows,
        lambda figure: draw.draw_clocks(figure, f.log.clocks, f.station_records, axis),
    )
    return Section("Clocks", tuple(text), plots=(plot,))


def _distances(f: Findings, axis: TimeAxis) -> Section:
    title = "Distances between prisms"
    if f.inter_prism is None or f.distance_errors is None:
        return Section(title, (f"Unknown: {f.problems['inter_prism']}.",))
    found, errors = f.inter_prism, f.distance_errors
    if not found.epochs:
        return Section(title, ("The tracks of the prisms do not overlap in time.",))
    text = [
        (
            f"{found.epochs - found.invalid_epochs} of {found.epochs} epochs at 20 Hz have no gap in any track. The robot was "
            f"stationary for {found.stationary_s:.1f} s in {len(found.stationary_ns)} intervals (shaded below)."
        )
    ]
    if not found.stationary_ns:
        text.append("There is no stationary interval of 3 s or more, so there are no stationary statistics.")
    if f.odometry_stationary_ns and not found.stationary_ns:
        text.append(
            f"According to the odometry the robot was stationary from {format_utc(f.odometry_stationary_ns[0][0])} to "
            f"{format_utc(f.odometry_stationary_ns[-1][1])} UTC, before or after this recording: check that the odometry is of "
            "this drive, and both clocks."
        )
    if not np.isfinite(errors.motion.speed_mps).any():
        text.append("Speed and angular rate are unknown, since there are no poses.")
    header = ("pair", "n", "layout (mm)", "mean (mm)", "std (mm)", "mean |error| (mm)", "95 % |error| (mm)")
    tables = (
        Table("Stationary: raw pairs", header, _pairs(found.static)),
        Table("At 20 Hz, interpolated", header, _pairs(found.dynamic)),
    )
    height_mm = panels_height_mm(len(errors.error_m) + 2)
    plots = (
        page_figure(
            "distances",
            "Distances minus those of the layout (black line). Stationary, a mean (dashed) other than 0 indicates an error of "
            "the layout, a frame or a prism constant; the width is the instruments' noise. Values beyond the axis count in the "
            "outermost bins.",
            90.0,
            lambda figure: draw.draw_histograms(figure, found),
        ),
        page_figure(
            "distances_over_time",
            "The same over time, interpolated, with the robot's speed and angular rate. An error proportional to speed "
            "indicates a time offset; peaks at starts and stops are due to linear interpolation between measurements.",
            height_mm,
            lambda figure: draw.draw_distance_errors(figure, errors, found.stationary_ns, axis),
        ),
    )
    return Section(title, tuple(text), tables, plots)


def _by_motion(f: Findings) -> Section:
    title = "Errors by motion"
    errors = f.distance_errors
    if errors is None or not np.isfinite(errors.motion.speed_mps).any():
        return Section(title, ("Unknown: requires the distances between all prisms, and poses.",))
    error_m = np.array(list(errors.error_m.values()))
    motion = errors.motion
    names = ("speed (m/s)", "acceleration (m/s²)", "angular rate (rad/s)")
    values = (motion.speed_mps, motion.acceleration_mps2, motion.angular_rate_radps)
    bins = [(name, binned(error_m, value)) for name, value in zip(names, values, strict=True)]
    if all(found is None for _, found in bins):
        return Section(title, ("There are too few distances, or the robot did not move.",))
    plots = [
        page_figure(
            "errors_by_motion",
            "Distance errors of all pairs by the motion of the robot; below, their number (the outermost bins include "
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
        "Mean error in mm by two quantities. Cells with fewer than 20 distances are empty; the outermost ones include "
        "values beyond them."
    )
    return [page_figure("errors_by_two", caption, 80.0, lambda figure: draw.draw_grids(figure, found))]


def _pairs(pairs: Sequence[PairDistances]) -> tuple[tuple[str, ...], ...]:
    return tuple(
        (pair.name, str(s.valid), *map(format_number, (s.reference, s.mean, s.std, s.mean_abs_error, s.p95)))
        for pair in pairs
        for s in (pair.statistics(),)
    )
