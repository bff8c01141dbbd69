from __future__ import annotations

from dataclasses import replace

from harness.files.records import PARAMETERS, measurement

from tsgt.analysis.report.sections.calibration import calibration_numbers, calibration_section
from tsgt.model import Matrix4, Parameters, PointMeasurement, TargetResidual
from tsgt.recording import Recording, RecordingHeader

START_NS = 1_700_000_000_000_000_000
AWAY: Matrix4 = ((1.0, 0.0, 0.0, 5.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
TARGETS = (
    TargetResidual(target=4, residual_m=0.003, leave_one_out_m=0.005),
    TargetResidual(target=7, residual_m=0.004, leave_one_out_m=None),
    TargetResidual(target=9, residual_m=None, leave_one_out_m=0.06),
)


def recording(*targets: tuple[TargetResidual, ...]) -> Recording:
    """Return a recording of three stations, of which 1 is the world, with these targets."""
    frames = (PARAMETERS.stations[0].T_station1_station, AWAY, AWAY)
    stations = tuple(
        replace(station, targets=fits, T_station1_station=frame)
        for station, fits, frame in zip(PARAMETERS.stations, targets, frames, strict=True)
    )
    return Recording(
        header=RecordingHeader(software="", created_ns=START_NS, source=""),
        parameters=Parameters(stations=stations, prisms=PARAMETERS.prisms),
        measurements=[measurement(0)],
        end_ns=START_NS,
    )


def test_each_target_has_a_row() -> None:
    """With residual and leave-one-out error, or as rejected; rejected targets do not count in the root mean square."""
    section = calibration_section(recording((), TARGETS, ()))
    (table,) = section.tables
    assert table.rows == (
        ("2", "4", "3.00", "5.00"),
        ("2", "7", "4.00", "unknown"),
        ("2", "9", "rejected", "60.00"),
    )
    assert section.text == (
        "Station 2: 2 targets used, root mean square 3.54 mm.",
        "The targets of station 3 are unknown.",
    )
    assert [plot.name for plot in section.plots] == ["calibration"]
    keys = calibration_numbers(recording((), TARGETS, ()))[2]
    assert round(keys["rms_mm"], 2) == 3.54
    assert keys["targets"][2] == {"target": 9, "residual_mm": None, "leave_one_out_mm": 60.0}


def test_recording_without_targets_has_a_reason() -> None:
    """One line, and no figure."""
    section = calibration_section(recording((), (), ()))
    assert len(section.text) == 1
    assert "contains no residuals of the targets" in section.text[0]
    assert not section.plots
    assert calibration_numbers(recording((), (), ())) == {}


def test_points_have_no_station_frames() -> None:
    """They are in frame station1 already."""
    point = PointMeasurement(
        station=1, prism=1, sequence=0, stamp_ns=START_NS, received_ns=START_NS, position_m=(1.0, 2.0, 3.0)
    )
    section = calibration_section(replace(recording((), (), ()), measurements=[point]))
    assert "no station frame is used" in section.text[0]
