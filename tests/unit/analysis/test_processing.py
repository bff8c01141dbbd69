from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import START, driving, stationary_scene

from tsgt.analysis.processing import has_raw_angles, process, with_estimator
from tsgt.analysis.setup_replacement import with_calibration, with_layout
from tsgt.analysis.validation import no_valid_pose_message
from tsgt.config import PrismLayout, StationCalibration, StationSetup
from tsgt.errors import ConfigError, RecordingError
from tsgt.estimation import PoseBatch, Reason
from tsgt.model import PointMeasurement, SetupCovariance, Status
from tsgt.recording import Recording, RecordingHeader

if TYPE_CHECKING:
    from tsgt.analysis.processing import Estimator
    from tsgt.model import Measurement, Parameters, Vector3

PATH = Path("field.jsonl")
SCENE = stationary_scene().moving(driving)
SCENE = replace(
    SCENE,
    parameters=replace(SCENE.parameters, pipeline=replace(SCENE.parameters.pipeline, estimator="linear")),
)


def recording_of(measurements: list[Measurement], parameters: Parameters = SCENE.parameters) -> Recording:
    """Return a recording of measurements, in the order given."""
    return Recording(
        header=RecordingHeader(software="test", created_ns=0, source="test"),
        parameters=parameters,
        measurements=measurements,
        end_ns=max((m.received_ns for m in measurements), default=None),
    )


def drive(*, delay_s: float = 0.1) -> list[Measurement]:
    """Return four seconds of measurements by three stations."""
    return [
        SCENE.measure(station, 0.4 * step + 0.11 * station, delay_s=delay_s)
        for step in range(10)
        for station in (1, 2, 3)
    ]


def test_poses_equal_those_of_the_robot() -> None:
    """Linear interpolation between exact measurements stays near the true curve."""
    poses = process(recording_of(drive()), path=PATH)
    truth = [driving((stamp - START) / 1e9)[1] for stamp in poses.stamp_ns[poses.valid].tolist()]
    np.testing.assert_allclose(poses.position_m[poses.valid], truth, atol=0.01)


def test_order_of_arrival_does_not_matter() -> None:
    """However late a measurement arrived."""
    measurements = drive()
    late = recording_of([*measurements[:5], *measurements[6:], measurements[5]])
    a, b = process(recording_of(measurements), path=PATH), process(late, path=PATH)
    np.testing.assert_array_equal(a.stamp_ns, b.stamp_ns)
    np.testing.assert_array_equal(a.position_m, b.position_m)


def test_invalid_poses_are_counted_by_reason() -> None:
    """Counts and valid poses make up all poses; reasons that do not occur are not listed."""
    poses = process(recording_of(drive()), path=PATH)
    counts = poses.invalid_counts()
    assert set(counts) == {"outage"}
    assert counts["outage"] + np.count_nonzero(poses.valid) == len(poses)


def test_redundant_station_without_measurements_is_accepted() -> None:
    """Its prism is measured by another station."""
    fourth = replace(SCENE.parameters.stations[2], station=4)
    parameters = replace(SCENE.parameters, stations=(*SCENE.parameters.stations, fourth))
    assert process(recording_of(drive(), parameters), path=PATH).valid.any()


def test_measurements_of_an_unknown_station_are_named() -> None:
    """The message says that the station has no parameters, not that it is missing."""
    parameters = replace(SCENE.parameters, stations=SCENE.parameters.stations[:2])
    with pytest.raises(RecordingError, match="station 3 measured it, but is not among the parameters"):
        process(recording_of(drive(), parameters), path=PATH)


def test_station_with_errors_only_is_named_with_them() -> None:
    """The most frequent status comes first."""
    spoilt = [
        replace(m, status=Status.NO_TARGET if i % 4 else Status.TILT) if m.station == 1 else m
        for i, m in enumerate(drive())
    ]
    with pytest.raises(
        RecordingError, match=r"prism 1 has no usable .*10 with status no_target \(7\), tilt \(3\)"
    ):
        process(recording_of(spoilt), path=PATH)


def dated_late(measurement: Measurement) -> Measurement:
    """Return a measurement that is dated two seconds after it arrived."""
    return replace(measurement, stamp_ns=measurement.received_ns + 2 * 10**9)


def test_measurements_dated_after_their_arrival_are_named() -> None:
    """Beside the statuses of the others; the message does not say that the station sent nothing."""
    measurements = [
        m if m.station != 1 else replace(m, status=Status.TILT) if i < 3 else dated_late(m)
        for i, m in enumerate(drive())
    ]
    with pytest.raises(
        RecordingError,
        match=r"prism 1 has no usable .*\(1 with status tilt \(1\), 9 dated more than 1 s after they arrived",
    ):
        process(recording_of(measurements), path=PATH)


def test_recording_with_only_measurements_dated_after_their_arrival_is_rejected() -> None:
    """The message counts them."""
    with pytest.raises(
        RecordingError, match="holds 30 measurements, all dated more than 1 s after they arrived"
    ):
        process(recording_of([dated_late(m) for m in drive()]), path=PATH)


@pytest.mark.parametrize("estimator", ["linear", "continuous"])
def test_measurements_of_one_instant_are_rejected(estimator: Estimator) -> None:
    """An unusable one at another time does not change that."""
    first, *others = drive()[:3]
    same = [first, *(replace(m, stamp_ns=first.stamp_ns) for m in others)]
    blind = replace(drive()[-1], status=Status.NO_TARGET)
    with pytest.raises(RecordingError, match=r"all of one instant.*record for longer"):
        process(with_estimator(recording_of([*same, blind]), estimator), path=PATH)


def test_contradicted_poses_have_their_own_advice() -> None:
    """It precedes that for outages, which every recording has."""
    poses = PoseBatch.blank(START + np.arange(3), (1, 2))
    poses.reason[:] = Reason.CONTRADICTED, Reason.OUTAGE, Reason.OUTAGE
    message = no_valid_pose_message(poses, SCENE.parameters)
    assert "a tripod, a prism or the IMU may have moved" in message
    assert "times overlap" not in message


def test_reason_of_computed_poses_precedes_outages() -> None:
    """If most epochs are outages and all computed poses are upside down, the layout is named."""
    mirrored = tuple(
        replace(p, position_m=(p.position_m[0], -p.position_m[1], p.position_m[2]))
        for p in SCENE.parameters.prisms
    )
    measurements = [*drive()[:6], *(SCENE.measure(station, 9.0) for station in (1, 2, 3))]
    with pytest.raises(RecordingError, match=r"outage 1.*the prism layout is mirrored") as error:
        process(recording_of(measurements, replace(SCENE.parameters, prisms=mirrored)), path=PATH)
    assert "tilt" in str(error.value)


def calibration_of(*numbers: int) -> StationCalibration:
    """Every station gets the same frame and an index error; ``z`` of stations 2 and 9 are uncertain."""
    setup = StationSetup(
        T_station1_station=SCENE.parameters.stations[0].T_station1_station, vertical_index_rad=2e-4
    )
    covariance = SetupCovariance(components=("station2.z", "station9.z"), matrix=((4.0, 1.0), (1.0, 9.0)))
    return StationCalibration(dict.fromkeys(numbers, setup), covariance)


def test_calibration_is_replaced_by_station() -> None:
    """Every station of the recording gets its new frame and instrument errors, everything else is unchanged."""
    given = calibration_of(1, 2, 3, 4)
    replaced = with_calibration(SCENE.parameters, given, path=Path("frames.toml"))
    assert [s.T_station1_station for s in replaced.stations] == [given.stations[1].T_station1_station] * 3
    assert [s.vertical_index_rad for s in replaced.stations] == [2e-4] * 3
    assert replaced.stations[1].prism_constant_m == SCENE.parameters.stations[1].prism_constant_m
    with pytest.raises(ConfigError, match=r"frames.toml: stations.3: missing"):
        with_calibration(SCENE.parameters, calibration_of(1, 2), path=Path("frames.toml"))


def layout_of(positions_m: dict[int, Vector3]) -> PrismLayout:
    """Return a layout in which ``x`` of prism 1 is uncertain."""
    return PrismLayout(positions_m, SetupCovariance(components=("prism1.x",), matrix=((1e-6,),)))


def test_layout_is_replaced_by_prism() -> None:
    """Every prism of the recording gets its new position."""
    layout = {k: (float(k), float(k * k), 0.0) for k in (1, 2, 3, 4)}
    replaced = with_layout(SCENE.parameters, layout_of(layout), path=Path("prisms.toml"))
    assert [(p.prism, p.position_m) for p in replaced.prisms] == [(k, layout[k]) for k in (1, 2, 3)]
    with pytest.raises(ConfigError, match=r"prisms.toml: prisms.2: missing"):
        with_layout(SCENE.parameters, layout_of({1: layout[1]}), path=Path("prisms.toml"))


def test_covariances_of_stations_and_prisms_are_joined() -> None:
    """Replacing one keeps the other; stations that the recording lacks are omitted."""
    layout = {k: (float(k), float(k * k), 0.0) for k in (1, 2, 3)}
    calibrated = with_calibration(SCENE.parameters, calibration_of(1, 2, 3), path=Path("frames.toml"))
    both = with_layout(calibrated, layout_of(layout), path=Path("prisms.toml"))
    joined = SetupCovariance(components=("station2.z", "prism1.x"), matrix=((4.0, 0.0), (0.0, 1e-6)))
    assert both.setup_covariance == joined
    again = with_calibration(both, calibration_of(1, 2, 3), path=Path("frames.toml"))
    assert again.setup_covariance == joined


def test_frames_matter_to_raw_angles_only() -> None:
    """Points are in frame 1 already."""
    point = PointMeasurement(station=1, prism=1, sequence=0, stamp_ns=0, received_ns=0, position_m=(1, 2, 3))
    assert not has_raw_angles([point])
    assert has_raw_angles([point, SCENE.measure(1, 0.0)])


def test_stations_without_common_time_give_no_pose() -> None:
    """The advice is to check the times."""
    apart = [
        SCENE.measure(station, 20.0 * station + 0.4 * step) for step in range(5) for station in (1, 2, 3)
    ]
    with pytest.raises(RecordingError, match="check that the stations' times overlap"):
        process(recording_of(sorted(apart, key=lambda m: m.stamp_ns)), path=PATH)


def test_timestamp_in_the_future_is_ignored() -> None:
    """One wrong timestamp, months after its arrival, does not make a recording unusable."""
    wrong = replace(drive()[0], stamp_ns=drive()[0].stamp_ns + 10_000_000 * 10**9)
    poses, same = (process(recording_of(m), path=PATH) for m in (drive(), [*drive(), wrong]))
    np.testing.assert_array_equal(poses.position_m, same.position_m)


def test_long_time_after_the_last_measurement_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """Status lines for months after the last measurement limit the poses, not the program."""
    monkeypatch.setattr("tsgt.analysis.processing.MAX_EPOCHS", 200)
    recording = replace(recording_of(drive()), end_ns=START + 10_000_000 * 10**9)
    assert 150 < len(process(recording, path=PATH)) <= 200


def test_degenerate_layout_is_rejected() -> None:
    """The message names the file of the layout."""
    layout = {1: (0.0, 0.0, 0.0), 2: (0.0, 0.0, 0.0), 3: (1.0, 0.0, 0.0)}
    with pytest.raises(ConfigError, match=r"^prisms.toml: prisms 1 and 2 are 0.0 mm apart"):
        with_layout(SCENE.parameters, layout_of(layout), path=Path("prisms.toml"))
