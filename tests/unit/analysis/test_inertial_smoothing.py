"""Smoothing of recordings with an IMU: from three stations, two and one, and where the IMU is not to be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.records import START
from harness.inertial.imu_recording import IMU, imu_recording, shaken_drive, true_positions_m
from scipy.spatial.transform import Rotation

from tsgt.analysis import inertial_smoothing
from tsgt.analysis.inertial_smoothing import UnusedInterval
from tsgt.analysis.smoothing import smooth_recording
from tsgt.errors import DegenerateGeometryError, RecordingError
from tsgt.estimation import Degradation, Reason, named_point
from tsgt.geometry import cartesian_to_polar, polar_to_cartesian
from tsgt.model import OdometryParameters, OdometrySamples, PolarMeasurement, SetupCovariance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.smoothing import SmoothedRecording
    from tsgt.geometry import FloatArray
    from tsgt.model import Measurement
    from tsgt.recording import Recording

PATH = Path("field.jsonl")
DRIVE = shaken_drive(26.0)
MARGIN = 40  # Epochs at either end


def smooth(recording: Recording) -> SmoothedRecording:
    """Smooth without refinement, which takes most of the time."""
    return smooth_recording(recording, path=PATH, refine="off")


def moved_measurement(measurement: Measurement, by_m: Sequence[float]) -> Measurement:
    """Return what a station measures that was moved by a vector in its frame."""
    assert isinstance(measurement, PolarMeasurement)
    assert measurement.slope_distance_m is not None
    angles = measurement.horizontal_angle_rad, measurement.zenith_angle_rad
    point = polar_to_cartesian(*angles, measurement.slope_distance_m) - by_m
    horizontal_rad, zenith_rad, distance_m = (float(each) for each in cartesian_to_polar(point))
    return replace(
        measurement,
        horizontal_angle_rad=horizontal_rad % (2 * np.pi),
        zenith_angle_rad=zenith_rad,
        slope_distance_m=distance_m,
    )


def shocked(recording: Recording, at_s: float) -> Recording:
    """Return the recording with a sample of the IMU that no driving explains."""
    at_ns = START + int(at_s * 1e9)
    samples = [
        replace(each, specific_force_mps2=((0.0, 90.0, 9.8), *each.specific_force_mps2[1:]))
        if 0 <= each.stamp_ns[0] - at_ns < each.stamp_ns[-1] - each.stamp_ns[0]
        else each
        for each in recording.imu_samples
    ]
    return replace(recording, imu_samples=samples)


def sunk(recording: Recording, at_s: float) -> Recording:
    """Return the recording with the tripod of station 1 30 mm lower from a time on."""
    measurements = [
        moved_measurement(each, [0.0, 0.0, -0.03])
        if each.station == 1 and each.stamp_ns > START + at_s * 1e9
        else each
        for each in recording.measurements
    ]
    return replace(recording, measurements=measurements)


def position_errors_m(found: SmoothedRecording) -> FloatArray:
    """Errors of the robot's origin at valid poses, (N,)."""
    poses = found.poses.select(found.poses.valid)
    errors: FloatArray = np.linalg.norm(
        poses.position_m - true_positions_m(DRIVE, poses.stamp_ns.astype(np.float64)), axis=1
    )
    return errors[MARGIN:-MARGIN]


@pytest.mark.parametrize(
    ("stations", "limit_mm"),
    [pytest.param(3, 1.2, marks=pytest.mark.slow), pytest.param(2, 2.0, marks=pytest.mark.slow), (1, 3.0)],
)
def test_stations_and_an_imu_suffice(stations: int, limit_mm: float) -> None:
    """All poses are valid, and more exact than three stations give without an IMU."""
    found = smooth(imu_recording(DRIVE, stations=stations))
    assert found.imu is not None
    assert found.imu.stations == tuple(range(1, stations + 1))
    assert found.poses.valid[MARGIN:-MARGIN].all()
    assert 1e3 * np.sqrt((position_errors_m(found) ** 2).mean()) < limit_mm
    assert 0.8 < found.motion.noise_scale < 1.2


def test_two_stations_without_samples_are_an_error() -> None:
    """The error of today, which names the IMU."""
    recording = replace(imu_recording(DRIVE, stations=2), imu_samples=[])
    with pytest.raises(DegenerateGeometryError, match="an IMU"):
        smooth(recording)


@pytest.mark.slow
def test_imu_that_contradicts_the_measurements_is_left_out() -> None:
    """Poses are those of the stations alone, with the reason."""
    x, y, z, w = (Rotation.from_quat(IMU.orientation_xyzw) * Rotation.from_rotvec([0.0, 0.08, 0.0])).as_quat()
    wrong = replace(IMU, orientation_xyzw=(x, y, z, w))
    found = smooth(imu_recording(DRIVE, imu=wrong))
    assert found.imu is None
    assert "the mounting of the IMU is wrong by 4." in found.imu_problem
    assert not (found.poses.degraded & Degradation.IMU_DISAGREES).any()
    assert 1e3 * np.sqrt((position_errors_m(found) ** 2).mean()) < 6.0


def test_samples_of_another_day_are_an_error_of_two_stations() -> None:
    """Which says how to go on."""
    recording = imu_recording(DRIVE, stations=2)
    later = [
        replace(each, stamp_ns=tuple(stamp_ns + 10**14 for stamp_ns in each.stamp_ns))
        for each in recording.imu_samples
    ]
    with pytest.raises(RecordingError, match=r"do not overlap with the measurements in time; .*; --no-imu"):
        smooth(replace(recording, imu_samples=later))


@pytest.mark.slow
def test_third_prism_that_is_not_measured_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two stations are two, whatever the layout: poses around a contradiction are left out, too."""
    window = UnusedInterval(10.0, 15.0, "contradiction")
    monkeypatch.setattr(inertial_smoothing, "contradicted_windows", lambda _: [window])
    recording = imu_recording(DRIVE)
    measurements = [each for each in recording.measurements if each.station < 3]
    found = smooth(replace(recording, measurements=measurements))
    assert found.imu is not None
    assert [(each.start_s, each.end_s) for each in found.imu.unused] == [(5.0, 20.0)]


@pytest.mark.parametrize(("shift_s", "used"), [(1.0, 40), (-1.0, 13), (86_400.0, 0)])
def test_wheel_odometry_of_another_time_is_not_used(shift_s: float, used: int) -> None:
    """Only samples within the time of the measurements count: the others have no effect."""
    recording = imu_recording(shaken_drive(8.0), stations=1)
    stamps = tuple(START + round(1e9 * (shift_s + 0.05 * n)) for n in range(1, 41))
    driven = OdometrySamples(
        sequence=0,
        received_ns=stamps[-1],
        stamp_ns=stamps,
        duration_ns=(50_000_000,) * len(stamps),
        instrument_time_ns=None,
        speed_mps=(0.5,) * len(stamps),
        yaw_rate_radps=None,
        valid=(True,) * len(stamps),
    )
    parameters = replace(recording.parameters, odometry=OdometryParameters())
    found = smooth(replace(recording, parameters=parameters, odometry=[driven]))
    assert found.imu is not None
    assert found.imu.odometry_samples == used
    assert (found.imu.fit.wheels is None) == (used == 0)


@pytest.mark.slow
def test_gap_of_the_samples_has_the_poses_of_the_stations_alone() -> None:
    """No valid pose there is worse than without an IMU."""
    recording = imu_recording(DRIVE)
    missing = [
        each for each in recording.imu_samples if not 10 * 10**9 < each.stamp_ns[0] - START < 13 * 10**9
    ]
    found = smooth(replace(recording, imu_samples=missing))
    alone = smooth(replace(recording, imu_samples=[]))
    assert found.imu is not None
    (gap,) = found.imu.unused
    assert gap.reason == "gap"
    assert (gap.start_s, gap.end_s) == pytest.approx((10.5, 13.0), abs=1.0)
    np.testing.assert_array_equal(np.diff(found.poses.stamp_ns), 50_000_000)
    time_s = (found.poses.stamp_ns - int(recording.measurements[0].stamp_ns)) / 1e9
    inside = (time_s > gap.start_s) & (time_s < gap.end_s)
    assert inside.sum() > 30
    np.testing.assert_array_equal(found.poses.position_m[inside], alone.poses.position_m[inside])


@pytest.mark.slow
def test_set_up_is_a_common_part_of_the_covariance() -> None:
    """As without an IMU: a second station that is uncertain by 2 mm shows in every pose."""
    recording = imu_recording(DRIVE, stations=2)
    known = SetupCovariance(components=("station2.x",), matrix=((4e-6,),))
    found = smooth(
        replace(recording, parameters=replace(recording.parameters, setup_covariance=known))
    ).poses.covariance_common[MARGIN:-MARGIN]
    assert np.sqrt(found[:, 0, 0]).min() > 0.2e-3
    assert np.sqrt(found[:, 0, 0]).max() < 4e-3


@pytest.mark.slow
def test_poses_of_the_imu_are_those_of_its_frame() -> None:
    """Its origin is one of the points that have a name."""
    recording = imu_recording(DRIVE, stations=2)
    point = named_point(recording.parameters, "imu")
    found = smooth(replace(recording, parameters=replace(recording.parameters, reference_point=point))).poses
    position, rotation = DRIVE.pose_at((found.stamp_ns - START) / 1e9)
    expected = position + rotation @ np.array(IMU.position_m)
    error_m = np.linalg.norm(found.position_m - expected, axis=1)[MARGIN:-MARGIN]
    assert 1e3 * np.sqrt((error_m**2).mean()) < 2.0


@pytest.mark.parametrize(
    ("stations", "displaced"), [pytest.param(3, False, marks=pytest.mark.slow), (1, True)]
)
def test_poses_of_one_station_allow_for_a_shock_before_them(stations: int, *, displaced: bool) -> None:
    """It may have turned the IMU, which a single prism does not tell."""
    recording = imu_recording(DRIVE, stations=stations)
    found = smooth(shocked(recording, 14.0)).poses
    after = found.valid & (found.stamp_ns > START + 15 * 10**9)
    before = found.valid & (found.stamp_ns < START + 14 * 10**9)
    unconfirmed = (found.degraded & Degradation.IMU_UNCONFIRMED) != 0
    assert after.sum() > 100
    assert not unconfirmed[before].any()
    assert (unconfirmed[after] == displaced).all()
    sigmas = np.sqrt(found.covariance[:, [3, 4, 5], [3, 4, 5]])
    assert (sigmas[after].min() > np.radians(0.5)) == displaced


@pytest.mark.parametrize(
    ("stations", "displaced"), [pytest.param(3, False, marks=pytest.mark.slow), (1, True)]
)
def test_poses_of_one_station_allow_for_shocks_before_the_recording(
    stations: int, *, displaced: bool
) -> None:
    """From its beginning on, if a master measured them that crashed."""
    recording = imu_recording(DRIVE, stations=stations)
    imu = recording.parameters.imu
    assert imu is not None
    before = replace(recording.parameters, imu=replace(imu, shocks_before=2))
    found, plain = smooth(replace(recording, parameters=before)).poses, smooth(recording).poses
    assert (((found.degraded & Degradation.IMU_UNCONFIRMED) != 0)[found.valid] == displaced).all()
    more = (found.covariance - plain.covariance)[found.valid, 5, 5]
    assert more == pytest.approx(2 * displaced * np.radians(0.5) ** 2, abs=2e-5)


@pytest.mark.slow
def test_poses_allow_for_each_shock() -> None:
    """Four knocks displace the IMU twice as far as one, on average; more are not allowed for."""
    recording = imu_recording(DRIVE, stations=1)
    once = smooth(shocked(recording, 10.0)).poses
    for at_s in (10.0, 12.0, 14.0, 16.0, 18.0):
        recording = shocked(recording, at_s)
    found = smooth(recording).poses
    for at_s, shocks in ((11.0, 1), (13.0, 2), (17.0, 4), (19.0, 4)):
        row = np.searchsorted(found.stamp_ns, START + int(at_s * 1e9))
        more = found.covariance[row, 5, 5] - once.covariance[row, 5, 5]
        assert more == pytest.approx((shocks - 1) * np.radians(0.5) ** 2, abs=2e-5)


def test_measurements_that_are_seconds_apart_are_not_doubted() -> None:
    """As those of a radio whose share of the air is limited."""
    recording = imu_recording(DRIVE, stations=1)
    measurements = recording.measurements[::9]
    assert np.diff([each.stamp_ns for each in measurements]).min() > 3 * 10**9
    found = smooth(replace(recording, measurements=measurements))
    assert found.imu is not None
    assert not found.imu.unused


@pytest.mark.parametrize("stations", [pytest.param(3, marks=pytest.mark.slow), 1])
def test_few_measurements_of_one_prism_between_outages_prove_nothing(stations: int) -> None:
    """They may be of a wrong prism: poses from the last measurement before on are invalid, those before are not."""
    recording = imu_recording(DRIVE, stations=stations)

    def measured(measurement: Measurement) -> bool:
        time_s = (measurement.stamp_ns - START) / 1e9
        return time_s < 8.0 or (measurement.station == 1 and 22.0 < time_s < 24.0)

    measurements = [
        moved_measurement(each, [0.4, 0.0, 0.0]) if each.stamp_ns > START + 20 * 10**9 else each
        for each in filter(measured, recording.measurements)
    ]
    assert 3 <= sum(each.stamp_ns > START + 20 * 10**9 for each in measurements) < 8
    found = smooth(replace(recording, measurements=measurements))
    assert found.imu is not None
    (unproven,) = found.imu.unused
    assert unproven.reason == "unproven"
    # Three stations have poses without the IMU up to the outage limit.
    assert not found.poses.valid[found.poses.stamp_ns > START + 8.6 * 10**9].any()
    assert found.poses.valid[found.poses.stamp_ns < START + 7.5 * 10**9][MARGIN:].all()


@pytest.mark.slow
@pytest.mark.parametrize(("stations", "displaced"), [(3, False), (2, True), (1, True)])
def test_poses_of_few_stations_allow_for_a_knock_in_a_gap_of_the_samples(
    stations: int, *, displaced: bool
) -> None:
    """It shows no shock."""
    recording = imu_recording(DRIVE, stations=stations)
    silent = [
        each for each in recording.imu_samples if not 12 * 10**9 < each.stamp_ns[0] - START < 17.3 * 10**9
    ]
    found = smooth(replace(recording, imu_samples=silent)).poses
    unconfirmed = (found.degraded & Degradation.IMU_UNCONFIRMED) != 0
    after = found.valid & (found.stamp_ns > START + 18 * 10**9)
    assert after.sum() > 100
    assert (unconfirmed[after] == displaced).all()
    assert not unconfirmed[found.stamp_ns < START + 11 * 10**9].any()


def test_clipped_samples_are_left_out() -> None:
    """The device measures up to 12 m/s^2, which bumps exceed: as exact as the gaps allow, and no pose is missing."""
    recording = imu_recording(DRIVE, stations=1)
    clipped = [
        replace(each, specific_force_mps2=tuple((x, y, min(z, 12.0)) for x, y, z in each.specific_force_mps2))
        for each in recording.imu_samples
    ]
    found = smooth(replace(recording, imu_samples=clipped))
    assert found.imu is not None
    assert len(found.imu.samples) < 26 * 200 - 50
    assert found.poses.valid[MARGIN:-MARGIN].all()
    assert 1e3 * np.sqrt((position_errors_m(found) ** 2).mean()) < 6.0


@pytest.mark.slow
def test_wrong_latency_of_the_imu_is_an_error_of_one_station() -> None:
    """A single prism tells it."""
    imu = replace(IMU, latency_ns=IMU.latency_ns + 40_000_000)
    with pytest.raises(RecordingError, match=r"latency of the IMU is wrong.*--imu-setup"):
        smooth(imu_recording(shaken_drive(60.0), stations=1, imu=imu))


@pytest.mark.parametrize(
    ("by_m", "moved"),
    [
        pytest.param(0.0, False, marks=pytest.mark.slow),
        (0.03, True),
        pytest.param(0.3, True, marks=pytest.mark.slow),
    ],
)
def test_poses_of_a_single_station_that_has_moved_are_invalid(by_m: float, *, moved: bool) -> None:
    """From just before the move on: the trajectory follows the station, and nothing tells where it is."""
    recording = imu_recording(DRIVE, stations=1)
    measurements = [
        moved_measurement(each, [by_m, 0.0, 0.0]) if each.stamp_ns > START + 14 * 10**9 else each
        for each in recording.measurements
    ]
    found = smooth(replace(recording, measurements=measurements)).poses
    after = found.stamp_ns > START + 14 * 10**9
    assert (found.reason[after] == Reason.CONTRADICTED).any() == moved
    assert found.valid[after].any() != moved
    assert found.valid[found.stamp_ns < START + (4 if moved else 14) * 10**9][MARGIN:].all()


@pytest.mark.slow
@pytest.mark.parametrize(("measured_s", "displaced"), [(5.0, True), (26.0, False)])
def test_shock_is_told_by_three_prisms_after_it_alone(measured_s: float, *, displaced: bool) -> None:
    """That the third was measured before says nothing."""
    recording = imu_recording(DRIVE)
    measurements = [
        each
        for each in recording.measurements
        if each.station < 3 or each.stamp_ns < START + measured_s * 1e9
    ]
    found = smooth(shocked(replace(recording, measurements=measurements), 14.0)).poses
    after = found.valid & (found.stamp_ns > START + 15 * 10**9)
    assert ((found.degraded[after] & Degradation.IMU_UNCONFIRMED) != 0).all() == displaced


@pytest.mark.slow
@pytest.mark.parametrize(("shock_s", "degraded"), [(None, True), (2.0, True), (23.8, False)])
def test_poses_of_three_stations_are_degraded_once_one_has_sunk(
    shock_s: float | None, *, degraded: bool
) -> None:
    """The triangle of the prisms stays what it was; the IMU tells, unless it was knocked itself."""
    recording = sunk(imu_recording(shaken_drive(40.0)), 24.0)
    found = smooth(recording if shock_s is None else shocked(recording, shock_s))
    assert found.imu is not None
    disagrees = (found.poses.degraded & Degradation.IMU_DISAGREES) != 0
    after = found.poses.valid & (found.poses.stamp_ns > START + 24 * 10**9)
    assert after.sum() > 200
    assert (disagrees[after] == degraded).all()
    assert not disagrees[found.poses.stamp_ns < START + 18 * 10**9].any()


@pytest.mark.slow
@pytest.mark.parametrize(("shock_s", "degraded"), [(None, True), (70.0, False)])
def test_all_poses_are_degraded_where_the_set_up_is_right_in_a_part_of_the_drive(
    shock_s: float | None, *, degraded: bool
) -> None:
    """Station 1 sinks in the middle, or the IMU was knocked there: it is left out."""
    recording = sunk(imu_recording(shaken_drive(140.0)), 70.0)
    found = smooth(recording if shock_s is None else shocked(recording, shock_s))
    assert found.imu is None
    assert ("in a part of the drive its set-up is right" in found.imu_problem) == degraded
    disagrees = (found.poses.degraded & Degradation.IMU_DISAGREES) != 0
    assert (disagrees[found.poses.valid] == degraded).all()
