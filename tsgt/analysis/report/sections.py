"""The sections of a report: which tables and figures, and what stands where something is missing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import TimeAxis, panels_height_mm
from tsgt.analysis.report import station_figures as draw
from tsgt.analysis.report.calibration import calibration
from tsgt.analysis.report.elements import LISTED, median, number, utc, wide
from tsgt.analysis.report.motion import binned, gridded
from tsgt.analysis.report.page import ReportFigure, Section, Table
from tsgt.analysis.report.pose_sections import estimators, perturbation, residuals, trajectory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.evaluation import PairDistances
    from tsgt.analysis.report.findings import Findings
    from tsgt.analysis.report.motion import DistanceErrorSeries
    from tsgt.geometry import FloatArray


def sections(f: Findings) -> list[Section]:
    """All sections in their order."""
    clock = TimeAxis.over(f.start_ns, f.end_ns)
    return [
        _stations(f, clock),
        _clocks(f, clock),
        _distances(f, clock),
        _by_motion(f),
        estimators(f, clock),
        trajectory(f, clock),
        residuals(f, clock),
        calibration(f.recording),
        perturbation(f),
    ]


def facts(f: Findings) -> Table:
    """Tell what the recording is."""
    parameters, poses = f.recording.parameters, f.poses
    rows = [
        ("file", f.path.name),
        ("written by", f"{f.recording.header.software}, {f.recording.header.source}"),
        ("first measurement", f"{utc(f.start_ns)} UTC"),
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


def _stations(f: Findings, clock: TimeAxis) -> Section:
    outage_limit_s = f.recording.parameters.pipeline.outage_limit_ns / 1e9
    rows = []
    for record in f.stations:
        each = f.station_statistics[record.station]
        series = f.log.radio.get(record.station)
        rows.append(
            (
                str(record.station),
                ", ".join(map(str, record.prisms)) or "-",
                str(each.measurements),
                str(each.usable),
                number(each.rate_hz, 2),
                number(each.longest_gap_s, 2),
                f"{each.gaps} ({each.in_gaps:.1%})",
                f"{number(each.distance_min_m, 0)} to {number(each.distance_max_m, 0)}",
                f"{number(each.delay_median_s, 2)} / {number(each.delay_p95_s, 2)}",
                *(
                    number(median(values), digits)
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
    n = len(f.stations)
    plots = [
        wide(
            "gaps",
            "Time from each usable measurement to the one before, and measurements that are not usable (crosses at the "
            "foot). Even rows of points low down are good; what is above the dotted line makes poses invalid. Diamonds: a "
            "station began so much later, or ended so much earlier, than the first and the last of all.",
            panels_height_mm(n),
            lambda figure: draw.draw_gaps(figure, f.stations, clock, outage_limit_s, f.end_ns),
        ),
        wide(
            "statuses",
            "What the instruments said of their measurements.",
            24.0 + 9.0 * n,
            lambda figure: draw.draw_statuses(figure, f.stations),
        ),
    ]
    text = (
        []
        if f.log.radio
        else ["The recording holds no status of the radio: RSSI, SNR and loss are not known."]
    )
    heard = {k: v for k, v in f.log.radio.items() if np.isfinite(v.rssi_dbm).any()}
    if heard:
        plots.append(
            wide(
                "radio",
                "How the master heard the stations. Losses that come with a falling SNR are a matter of distance or "
                "antennas; losses at a good SNR are collisions or a computer that is late.",
                panels_height_mm(3),
                lambda figure: draw.draw_radio(figure, heard, clock),
            )
        )
    events: tuple[Table, ...] = ()
    if f.log.events:
        listed = [(utc(stamp_ns), message) for stamp_ns, message in f.log.events[:LISTED]]
        more = f", the first {LISTED} of {len(f.log.events)}" if len(f.log.events) > LISTED else ""
        events = (Table(f"Events{more}", ("time (UTC)", "what"), tuple(listed)),)
    caption = "Medians of RSSI, SNR and loss; the delay is from the measurement to its arrival."
    return Section("Stations", tuple(text), (Table(caption, header, tuple(rows)), *events), tuple(plots))


def _clocks(f: Findings, clock: TimeAxis) -> Section:
    bounded = any(np.isfinite(s.bound_ns).any() for s in f.stations)
    if not bounded and not f.log.clocks:
        return Section(
            "Clocks",
            ("The recording holds neither synchronisations nor bounds of the stamps: nothing to show.",),
        )
    text = []
    if not f.log.clocks:
        text.append(
            "No synchronisations were recorded. The protocol superframe has none: each measurement is timed from a beacon; "
            "the bounds below hold for that."
        )
    caption = (
        "Above, where it was recorded: the station's clock against the master's (positive: the station has gained) with "
        "its bound. Below: by how much the time of each measurement may be wrong at most. A millisecond is a millimetre at "
        "1 m/s."
    )
    rows = bool(f.log.clocks) + sum(bool(np.isfinite(s.bound_ns).any()) for s in f.stations)
    plot = wide(
        "clocks",
        caption,
        panels_height_mm(rows) + 8 * rows,
        lambda figure: draw.draw_clocks(figure, f.log.clocks, f.stations, clock),
    )
    return Section("Clocks", tuple(text), plots=(plot,))


def _distances(f: Findings, clock: TimeAxis) -> Section:
    title = "Distances between prisms"
    if f.inter_prism is None or f.distance_errors is None:
        return Section(title, (f"Not known: {f.problems['inter_prism']}.",))
    found, ride = f.inter_prism, f.distance_errors
    if not found.epochs:
        return Section(title, ("The tracks of the prisms have no time in common.",))
    text = [
        (
            f"{found.epochs - found.invalid_epochs} of {found.epochs} epochs at 20 Hz have no gap in any track. The robot stood "
            f"still for {found.stationary_s:.1f} s in {len(found.stationary_ns)} intervals (shaded below)."
        )
    ]
    if not found.stationary_ns:
        text.append(
            "There is no interval of 3 s or more in which it stood still, so nothing is told of standing."
        )
    if f.odometry_ns and not found.stationary_ns:
        text.append(
            f"The odometry has the robot standing from {utc(f.odometry_ns[0][0])} to {utc(f.odometry_ns[-1][1])} UTC, before "
            "or after this recording: is it of this drive, and were both clocks right?"
        )
    if not np.isfinite(ride.motion.speed_mps).any():
        text.append("How it moved is not known, since there are no poses.")
    header = ("pair", "n", "layout (mm)", "mean (mm)", "std (mm)", "mean |error| (mm)", "95 % |error| (mm)")
    tables = (
        Table("Standing still: raw pairs", header, _pairs(found.static)),
        Table("At 20 Hz, interpolated", header, _pairs(found.dynamic)),
    )
    height_mm = panels_height_mm(len(ride.error_m) + 2)
    plots = (
        wide(
            "distances",
            "Distances less those of the layout (black line). Standing still, a mean (dashed) off the line is the layout, "
            "a frame or a prism constant; the width is the instruments' noise. What is beyond the axis counts at its ends.",
            90.0,
            lambda figure: draw.draw_histograms(figure, found),
        ),
        wide(
            "distances_over_time",
            "The same over time, interpolated, with the robot's speed and angular rate. Errors that grow with speed are "
            "time's; peaks at starts and stops come from straight lines between measurements.",
            height_mm,
            lambda figure: draw.draw_distance_errors(figure, ride, found.stationary_ns, clock),
        ),
    )
    return Section(title, tuple(text), tables, plots)


def _by_motion(f: Findings) -> Section:
    title = "Errors by motion"
    ride = f.distance_errors
    if ride is None or not np.isfinite(ride.motion.speed_mps).any():
        return Section(title, ("Not known: it needs the distances between all prisms, and poses.",))
    errors = np.array(list(ride.error_m.values()))
    motion = ride.motion
    names = ("speed (m/s)", "acceleration (m/s²)", "angular rate (rad/s)")
    values = (motion.speed_mps, motion.acceleration_mps2, motion.angular_rate_radps)
    bins = [(name, binned(errors, value)) for name, value in zip(names, values, strict=True)]
    if all(found is None for _, found in bins):
        return Section(title, ("There are too few distances, or the robot did not move.",))
    plots = [
        wide(
            "errors_by_motion",
            "Distance errors of all pairs, sorted by how the robot moved; below, how many there are (the outermost bins "
            "hold what is beyond them). Acceleration is of the speed: negative while the robot slows down.",
            75.0,
            lambda figure: draw.draw_bins(figure, bins),
        )
    ]
    plots += _grids(errors, ride, names)
    return Section(title, plots=tuple(plots))


def _grids(errors: FloatArray, ride: DistanceErrorSeries, names: tuple[str, str, str]) -> list[ReportFigure]:
    motion = ride.motion
    found = [
        (name, names[2], grid)
        for name, x in ((names[0], motion.speed_mps), (names[1], motion.acceleration_mps2))
        if (grid := gridded(errors, x, motion.angular_rate_radps)) is not None
    ]
    if not found:
        return []
    caption = (
        "Mean error by two quantities at a time, in mm. Cells with fewer than 20 distances are empty; the outermost ones "
        "hold what is beyond them."
    )
    return [wide("errors_by_two", caption, 80.0, lambda figure: draw.draw_grids(figure, found))]


def _pairs(pairs: Sequence[PairDistances]) -> tuple[tuple[str, ...], ...]:
    return tuple(
        (pair.name, str(s.valid), *map(number, (s.reference, s.mean, s.std, s.mean_abs_error, s.p95)))
        for pair in pairs
        for s in (pair.statistics(),)
    )
