"""Records of the stream as text."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from harness.files.records import (
    CLOCK,
    EVENT,
    IMU_STATUS,
    ODOMETRY_STATUS,
    PARAMETERS,
    POSE,
    SETUP,
    STATUS,
    measurement,
)
from scipy.spatial.transform import Rotation

from tsgt.cli.render import render, yaw_pitch_roll_deg
from tsgt.model import PipelineParameters, SetupCovariance
from tsgt.recording import HelloRecord, SetupRecord, ValidityLimits, encode_line


@pytest.mark.parametrize("seed", range(5))
def test_angles_agree_with_scipy(seed: int) -> None:
    """Yaw, pitch and roll are scipy's intrinsic ZYX angles."""
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    x, y, z, w = rotation.as_quat(canonical=True)
    assert yaw_pitch_roll_deg((x, y, z, w)) == pytest.approx(rotation.as_euler("ZYX", degrees=True))


def test_pitch_of_90_degrees() -> None:
    """Rounding beyond the domain of asin is tolerated."""
    s = math.sqrt(0.5) * (1 + 1e-15)
    assert yaw_pitch_roll_deg((0.0, s, 0.0, s))[1] == pytest.approx(90.0)


def test_measurement_without_distance_says_so() -> None:
    """An angle-only measurement has no distance."""
    text = render("measurement", encode_line(replace(measurement(0), slope_distance_m=None)))
    assert text is not None
    assert "no distance" in text


def test_greeting_states_the_limits_of_both_kinds() -> None:
    """With the estimator linear there are none."""
    limits = PipelineParameters(
        position_sigma_limit_m=0.03, predicted_rotation_sigma_limit_rad=math.radians(4)
    )
    text = render(
        "hello", encode_line(HelloRecord(limits=ValidityLimits.of(replace(PARAMETERS, pipeline=limits))))
    )
    assert text is not None
    assert text.endswith("Limits at robot: smoothed 30 mm, 2 deg; predicted 150 mm, 4 deg.")
    linear = ValidityLimits.of(replace(PARAMETERS, pipeline=PipelineParameters(estimator="linear")))
    text = render("hello", encode_line(HelloRecord(limits=linear)))
    assert text is not None
    assert "Limits" not in text


def test_setup_names_stations_and_their_uncertainty() -> None:
    """With fences, radio and recording."""
    known = SetupCovariance(components=("station2.x", "station2.z"), matrix=((4e-6, 0.0), (0.0, 1e-6)))
    parameters = replace(PARAMETERS, setup_covariance=known)
    setup = SetupRecord.of(parameters, SETUP.stamp_ns, protocol="classic", authenticated=False)
    text = render("setup", encode_line(setup))
    assert text == (
        "22:13:20.000  setup  robot in station1, continuous, 20 Hz; station 1 on prism 1 at 0.000 0.000 0.000 m; "
        "station 2 on prism 2 at 0.000 0.000 0.000 m (sigmas 2.0 0.0 1.0 mm); "
        "station 3 on prism 3 at 0.000 0.000 0.000 m; classic, not authenticated"
    )
    whole = render("setup", encode_line(SETUP))
    assert whole is not None
    assert whole.endswith("; geofence site; superframe; recorded in master-20261121T055100Z.jsonl")


def test_degraded_pose_says_by_what() -> None:
    """Beside its validity."""
    degraded = replace(POSE, quality="degraded", degraded_by=("old_measurements", "uncertain"))
    text = render("pose", encode_line(degraded))
    assert text is not None
    assert "valid, degraded (old_measurements, uncertain)" in text


def test_pose_at_a_delay_says_so_and_names_its_point() -> None:
    """A position is of a point, and one epoch has several poses."""
    delayed = replace(POSE, kind="smoothed", delay_s=0.6, child_frame="lidar")
    text = render("pose", encode_line(delayed))
    assert text is not None
    assert "pose  smoothed at 0.6 s  valid  lidar 1.000 2.000 -0.100 m" in text


def test_clock_text_has_the_sign_in_words() -> None:
    """A negative offset is a clock that is behind."""
    assert render("clock", encode_line(CLOCK)) == (
        "22:13:22.000  clock of station 2 is 7200.000123 s behind the master's, bound 0.310 ms, +9.70 ppm; "
        "1 of 1 exchanges used (regression), reset"
    )


def test_status_text_omits_unknown_values() -> None:
    """Known values have their units."""
    station = replace(
        STATUS.stations[0],
        last_heard_s=0.1,
        rate_hz=1.7,
        loss=0.02,
        rssi_dbm=-90.4,
        snr_db=8.0,
        clock_bound_ns=310_000,
    )
    text = render("status", encode_line(replace(STATUS, stations=(station, STATUS.stations[1]))))
    assert text is not None
    assert (
        "station 1: 4 of 5 usable, last ok 0.20 s ago, received 0.10 s ago, 1.7 Hz, 2 % lost, -90 dBm, SNR 8 dB, "
        "clock bound 0.3 ms; station 2: no measurement yet"
    ) in text


def test_status_text_has_the_imu() -> None:
    """Last, with what is wrong in words."""
    imu = replace(IMU_STATUS, use="disagrees", disagreement="the gyro and the prisms disagree")
    text = render("status", encode_line(replace(STATUS, imu=imu)))
    assert text is not None
    assert text.endswith(
        "; IMU: 2000 samples, 199.9 Hz, 1 gaps (3 samples lost), 0 saturated, clock -12.5 ppm, disagrees, "
        "the gyro and the prisms disagree, last 0.04 s ago"
    )


def test_status_text_has_the_wheels() -> None:
    """Scale, slip and what is rejected in percent."""
    text = render("status", encode_line(replace(STATUS, odometry=ODOMETRY_STATUS)))
    assert text is not None
    assert text.endswith(
        "; wheel odometry: 400 samples, 20.0 Hz, 1 gaps (2 samples lost), 3 untrusted, used, scale +1.25 +/- 0.20 %, "
        "slip -2.1 +/- 1.2 %, 25 % rejected, last 0.08 s ago"
    )


@pytest.mark.parametrize("stamp_ns", [0, 2**63 - 1])
def test_any_time_can_be_printed(stamp_ns: int) -> None:
    """A clock that was never set does not fail."""
    assert render("event", encode_line(replace(EVENT, stamp_ns=stamp_ns))) is not None
