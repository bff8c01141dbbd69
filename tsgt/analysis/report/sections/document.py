"""All sections of the report in their order, and the facts about the recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.figures import TimeAxis
from tsgt.analysis.refinement import refinement_rows, refinement_text
from tsgt.analysis.report.page import MAX_LISTED, UNKNOWN, Section, Table, format_utc
from tsgt.analysis.report.sections.calibration import calibration_section
from tsgt.analysis.report.sections.diagnosis import diagnosis_section
from tsgt.analysis.report.sections.distances import distance_section, motion_section
from tsgt.analysis.report.sections.imu import imu_section
from tsgt.analysis.report.sections.live import live_section
from tsgt.analysis.report.sections.poses import estimator_section, perturbation_section, residual_section
from tsgt.analysis.report.sections.stations import clock_section, station_section
from tsgt.analysis.report.sections.trajectories import pose_section, reference_section
from tsgt.analysis.text_file import utf8_name

if TYPE_CHECKING:
    from tsgt.analysis.report.findings import Findings


def report_sections(f: Findings) -> list[Section]:
    """Return all sections in their order: those that help most to decide come first."""
    axis = TimeAxis.over(f.start_ns, f.end_ns)
    found = (
        diagnosis_section(f.diagnosis, f.problems.get("diagnosis"), *_refinement(f)),
        reference_section(f, axis),
        pose_section(f, axis),
        live_section(f.live, f.point),
        estimator_section(f, axis),
        imu_section(f, axis),
        distance_section(f, axis),
        residual_section(f, axis),
        calibration_section(f.recording),
        station_section(f, axis),
        clock_section(f, axis),
        motion_section(f),
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
        ("file", utf8_name(f.path.name)),
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
