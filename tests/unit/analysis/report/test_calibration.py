from __future__ import annotations

from dataclasses import replace

from harness.records import PARAMETERS, measurement

from tsgt.analysis.report.calibration import calibration, calibration_keys
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
    """Three stations, of which 1 is the world, with these targets."""
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


def test_each_target_has_its_row() -> None:
    """With its residual, what the others predict, or that it was rejected; rejected ones do not count in the mean."""
    section = calibration(recording((), TARGETS, ()))
    (table,) = section.tables
    assert table.rows == (
        ("2", "4", "3.00", "5.00"),
        ("2", "7", "4.00", "-"),
        ("2", "9", "rejected", "60.00"),
    )
    assert section.text == (
        "Station 2: 2 targets used, root mean square 3.54 mm.",
        "Of station 3 nothing is known of targets.",
    )
    assert [plot.name for plot in section.plots] == ["calibration"]
    keys = calibration_keys(recording((), TARGETS, ()))[2]
    assert round(keys["rms_mm"], 2) == 3.54
    assert keys["targets"][2] == {"target": 9, "residual_mm": None, "leave_one_out_mm": 60.0}


def test_a_recording_without_targets_says_so() -> None:
    """In a line, and there is no figure."""
    section = calibration(recording((), (), ()))
    assert len(section.text) == 1
    assert "does not say how well the targets fitted" in section.text[0]
    assert not section.plots
    assert calibration_keys(recording((), (), ())) == {}


def test_points_have_no_station_frames() -> None:
    """They came in frame station1, whoever made that."""
    point = PointMeasurement(
        station=1, prism=1, sequence=0, stamp_ns=START_NS, received_ns=START_NS, position_m=(1.0, 2.0, 3.0)
    )
    section = calibration(replace(recording((), (), ()), measurements=[point]))
    assert "no station frame is used" in section.text[0]
