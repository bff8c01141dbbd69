from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.drives.scene import START, Motion, stationary_scene

from tsgt.estimation import build_observations, build_tracks
from tsgt.estimation.observations import INSTRUMENT_TIME_SIGMA_S, MIN_SIGMA_M, centroid_m
from tsgt.geometry import exp_so3, log_so3
from tsgt.geometry.batch import fit_trajectory
from tsgt.model import InstrumentNoise, MotionPrior, PointMeasurement


def fast(time_s: float) -> Motion:
    """Rotation and position of a robot at 1.5 m/s, turning on its way across the lines of sight."""
    yaw = 0.3 * np.sin(0.5 * time_s)
    return exp_so3(np.array([0.0, 0.0, yaw])), np.array([30.0 - 0.75 * time_s, 15.0 + 1.3 * time_s, -1.0])


SCENE = stationary_scene().moving(fast)


@pytest.mark.parametrize("stated_ns", [1, 30_000, 4_000_000])
def test_time_sigma_includes_the_instruments(stated_ns: int) -> None:
    """Time sigma includes the instruments."""
    measured = replace(SCENE.measure(1, 1.0), stamp_sigma_ns=stated_ns, sequence=10**7)
    observations, _ = build_observations(SCENE.parameters, [measured], origin_ns=START)
    expected_s = np.hypot(stated_ns / 1e9, INSTRUMENT_TIME_SIGMA_S)
    assert observations.time_sigma_s == pytest.approx([expected_s], rel=1e-2)


@pytest.mark.parametrize("stated_ns", [0, 30_000])
def test_uncertain_times_of_a_station_enlarge_the_covariance(stated_ns: int) -> None:
    """A station over a network, whose times are uncertain by 9 ms; the others are not concerned."""
    stations = tuple(
        replace(each, time_sigma_s=0.009 if each.station == 2 else 0.0) for each in SCENE.parameters.stations
    )
    parameters = replace(SCENE.parameters, stations=stations)
    measured = [replace(SCENE.measure(s, 1.0), stamp_sigma_ns=stated_ns, sequence=10**7) for s in (1, 2)]
    observations, _ = build_observations(parameters, measured, origin_ns=START)
    cable_s = np.hypot(stated_ns / 1e9, INSTRUMENT_TIME_SIGMA_S if stated_ns else 0.0)
    assert observations.time_sigma_s == pytest.approx([cable_s, np.hypot(cable_s, 0.009)], rel=1e-2)
    tracks = build_tracks(parameters, measured)
    assert [tracks[prism].time_sigmas_ns.tolist() for prism in (1, 2)] == [
        [stated_ns],
        [round(np.hypot(stated_ns, 9e6))],
    ]


def test_noise_has_a_minimum() -> None:
    """Noise has a minimum."""
    none = InstrumentNoise(range_sigma_m=0.0, range_sigma_ppm=0.0, angle_sigma_rad=0.0, pointing_sigma_m=0.0)
    stations = tuple(replace(station, noise=none) for station in SCENE.parameters.stations)
    parameters = replace(SCENE.parameters, stations=stations)
    polar = SCENE.measure(1, 1.0)
    point = PointMeasurement(
        station=2,
        prism=2,
        sequence=0,
        stamp_ns=polar.stamp_ns,
        received_ns=polar.received_ns,
        position_m=(1.0, 2.0, 3.0),
    )
    observations, _ = build_observations(parameters, [polar, point], origin_ns=START)
    assert observations.sigmas_m.tolist() == [[MIN_SIGMA_M] * 3] * 2


def test_imported_time_is_exact() -> None:
    """Imported time is exact."""
    observations, _ = build_observations(SCENE.parameters, [SCENE.measure(1, 1.0)], origin_ns=START)
    assert observations.time_sigma_s.tolist() == [0.0]


def test_time_sigma_falls_with_the_sequence_number() -> None:
    """Time sigma falls with the sequence number."""
    measurements = [replace(SCENE.measure(1, 0.4 * n), sequence=n, stamp_sigma_ns=30_000) for n in range(50)]
    observations, _ = build_observations(SCENE.parameters, measurements, origin_ns=START)
    assert np.all(np.diff(observations.time_sigma_s) < 0)
    assert observations.time_sigma_s[0] > 3e-3


def test_initial_time_error_gives_consistent_poses() -> None:
    """4 ms of one station are 6 mm of a robot at 1.5 m/s."""
    measurements = [
        replace(m, sequence=step, stamp_sigma_ns=30_000, stamp_ns=m.stamp_ns + 4_000_000 * (m.station == 2))
        for step in range(20)
        for m in [SCENE.measure(station, 0.4 * step + 0.13 * station) for station in (1, 2, 3)]
    ]
    observations, _ = build_observations(SCENE.parameters, measurements, origin_ns=START)
    times_s = np.arange(1.0, 7.0, 0.05)
    states, covariance = fit_trajectory(observations, prior=MotionPrior(), noise_scale=1.0).trajectory.at(
        times_s
    )
    rotation, position = (np.array(part) for part in zip(*map(fast, times_s.tolist()), strict=True))
    turned = log_so3(np.swapaxes(states.rotation, 1, 2) @ rotation)
    middle = position + rotation @ centroid_m(SCENE.parameters)
    errors = np.concatenate([middle - states.position, turned], axis=1)
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance[:, :6, :6], errors[..., None])[..., 0])
    assert nees.max() < 20.0


def test_instrument_errors_are_corrected_in_both_estimators() -> None:
    """Angles that read an index and a collimation error give the same points as angles without."""
    exact = SCENE.measure(2, 1.0)
    index, collimation = 3e-4, -2e-4
    stations = tuple(
        replace(station, vertical_index_rad=index, collimation_rad=collimation)
        for station in SCENE.parameters.stations
    )
    parameters = replace(SCENE.parameters, stations=stations)
    read = replace(
        exact,
        zenith_angle_rad=exact.zenith_angle_rad + index,
        horizontal_angle_rad=exact.horizontal_angle_rad - collimation / np.sin(exact.zenith_angle_rad),
    )
    expected, _ = build_observations(SCENE.parameters, [exact], origin_ns=START)
    found, _ = build_observations(parameters, [read], origin_ns=START)
    assert found.points_m == pytest.approx(expected.points_m, abs=1e-5)
    tracks = [build_tracks(*each)[2] for each in ((SCENE.parameters, [exact]), (parameters, [read]))]
    assert tracks[1].points_m == pytest.approx(tracks[0].points_m, abs=1e-5)
