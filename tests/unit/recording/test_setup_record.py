"""The record ``setup``: stations' frames with covariance, prisms, and what the estimator sends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.files.records import PARAMETERS, SETUP
from scipy.spatial.transform import Rotation

from tsgt.model import PipelineParameters, SetupCovariance
from tsgt.recording import SETUP_START, SetupRecord, decode, encode_line


def test_line_begins_with_its_type_and_reads_back() -> None:
    """The stream server recognises it by its start."""
    line = encode_line(SETUP)
    assert line.startswith(SETUP_START)
    assert decode(SetupRecord, line) == SETUP


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("angle_rad", [0.0, 0.3, 3.1, np.pi])
def test_station_frame_is_the_calibrated_one(seed: int, angle_rad: float) -> None:
    """As position and quaternion, for all rotations, also half a turn."""
    axis = np.random.default_rng(seed).normal(size=3)
    rotation = Rotation.from_rotvec(angle_rad * axis / np.linalg.norm(axis))
    (a, b, c), (d, e, f), (g, h, i) = rotation.as_matrix().tolist()
    T = ((a, b, c, 5.0), (d, e, f, -7.0), (g, h, i, 0.5), (0.0, 0.0, 0.0, 1.0))
    stations = (PARAMETERS.stations[0], replace(PARAMETERS.stations[1], T_station1_station=T))
    station = SetupRecord.of(replace(PARAMETERS, stations=stations), 0).stations[1]
    assert station.position_m == (5.0, -7.0, 0.5)
    assert station.orientation_xyzw[3] >= 0
    assert np.linalg.norm(station.orientation_xyzw) == pytest.approx(1, abs=1e-15)
    found = Rotation.from_quat(station.orientation_xyzw).as_matrix()
    np.testing.assert_allclose(found, rotation.as_matrix(), atol=1e-12)


def test_covariance_of_a_frame_is_its_part_of_the_joint_one() -> None:
    """In the order of the stream, whatever the order of the calibration; missing components are exact."""
    known = SetupCovariance(
        components=("station2.rotation_z", "prism1.x", "station2.x"),
        matrix=((4e-6, 0.0, 1e-6), (0.0, 1.0, 0.0), (1e-6, 0.0, 9e-6)),
    )
    first, second, third = SetupRecord.of(replace(PARAMETERS, setup_covariance=known), 0).stations
    expected = np.zeros((6, 6))
    expected[0, 0], expected[5, 5], expected[0, 5], expected[5, 0] = 9e-6, 4e-6, 1e-6, 1e-6
    assert second.covariance == tuple(expected.ravel())
    assert first.covariance == (0.0,) * 36  # it defines the frame
    assert third.covariance is None  # unknown


def test_linear_has_no_lag() -> None:
    """Nor delays; what ``continuous`` sends is stated."""
    delays = PipelineParameters(
        estimator="linear", period_ns=100_000_000, smoothed_delays_ns=(200_000_000, 1_000_000_000)
    )
    linear = SetupRecord.of(replace(PARAMETERS, pipeline=delays), 0)
    continuous = SetupRecord.of(replace(PARAMETERS, pipeline=replace(delays, estimator="continuous")), 0)
    assert (linear.rate_hz, linear.lag_s, linear.smoothed_delays_s) == (10.0, None, ())
    assert (continuous.lag_s, continuous.smoothed_delays_s) == (delays.lag_ns / 1e9, (0.2, 1.0))


def test_prisms_name_the_station_that_tracks_them() -> None:
    """The first of several, or none."""
    first, second, third = PARAMETERS.stations
    stations = (first, replace(second, prism=1), replace(third, prism=2))
    prisms = SetupRecord.of(replace(PARAMETERS, stations=stations), 0).prisms
    assert [(prism.id, prism.station) for prism in prisms] == [(1, 1), (2, 3), (3, None)]
