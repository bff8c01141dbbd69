"""What simulated stations measure is the truth plus the noise stated."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.arrivals import simulated_measurements

from tsgt.config import MotionConfig, NoiseConfig, ScenarioConfig, scenario_parameters
from tsgt.geometry import corrected_distance, invert, polar_to_cartesian, transform_points
from tsgt.master.tracks import build_tracks
from tsgt.simulation.world import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.model import PolarMeasurement

START_NS = 1_700_000_000_000_000_000
SILENT = NoiseConfig(range_sigma_mm=0.0, range_sigma_ppm=0.0, angle_sigma_arcsec=0.0, pointing_sigma_mm=0.0)


def _with_noise(noise: NoiseConfig, **changes: object) -> ScenarioConfig:
    scenario = ScenarioConfig()
    stations = tuple(station.model_copy(update={"noise": noise}) for station in scenario.stations)
    return scenario.model_copy(update={"stations": stations, **changes})


def _measure(
    scenario: ScenarioConfig, duration_s: float = 120.0, seed: int = 1
) -> tuple[World, list[PolarMeasurement]]:
    world_generator, station_generator = np.random.default_rng(seed).spawn(2)
    prisms = np.array([prism.position_m for prism in scenario.prisms])
    world = World(scenario.motion, prisms, duration_s, world_generator)
    return world, simulated_measurements(scenario, world, station_generator, start_ns=START_NS)


def _true_points(world: World, measurements: list[PolarMeasurement]) -> NDArray[np.float64]:
    times_s = np.array([(m.stamp_ns - START_NS) / 1e9 for m in measurements])
    return world.prism_at(times_s, measurements[0].prism - 1)


def test_without_noise_the_pipeline_gets_the_truth_back() -> None:
    """Constant, frames and angles are exactly undone by the way every real measurement takes."""
    scenario = _with_noise(SILENT)
    world, measurements = _measure(scenario)
    for prism, track in build_tracks(scenario_parameters(scenario), measurements).items():
        true = world.prism_at((track.times_ns - START_NS) / 1e9, prism - 1)
        np.testing.assert_allclose(track.points_m, true, atol=1e-6)  # a nanosecond's rounding of the stamps


def test_the_raw_distance_lacks_the_prism_constant() -> None:
    """The instrument's slope distance is 10 mm short of the prism, as the constant says."""
    world, measurements = _measure(_with_noise(SILENT))
    mine = [m for m in measurements if m.station == 1]
    raw = np.array([m.slope_distance_m for m in mine])
    np.testing.assert_allclose(np.linalg.norm(_true_points(world, mine), axis=1) - raw, 0.010, atol=1e-6)


@pytest.mark.parametrize(
    ("noise", "direction", "sigma_m"),
    [
        (SILENT.model_copy(update={"range_sigma_mm": 2.0}), "along", 0.002),
        (SILENT.model_copy(update={"range_sigma_ppm": 100.0}), "along", 100e-6),
        (SILENT.model_copy(update={"angle_sigma_arcsec": 20.0}), "across", math.radians(20 / 3600)),
        (SILENT.model_copy(update={"angle_sigma_arcsec": 20.0}), "up", math.radians(20 / 3600)),
        (SILENT.model_copy(update={"pointing_sigma_mm": 1.0}), "along", 0.001),
        (SILENT.model_copy(update={"pointing_sigma_mm": 1.0}), "across", 0.001),
        (SILENT.model_copy(update={"pointing_sigma_mm": 1.0}), "up", 0.001),
    ],
)
def test_noise_is_as_large_as_stated(noise: NoiseConfig, direction: str, sigma_m: float) -> None:
    """Each part of the noise acts in its direction with its sigma; angles and ppm grow with the distance."""
    still = MotionConfig(speeds_mps=(0.0,), speed_weights=(1.0,), area_centre_m=(60.0, 45.0, 60.0))
    scenario = _with_noise(noise, motion=still)
    world, measurements = _measure(scenario, duration_s=1000.0)
    mine = [m for m in measurements if m.station == 2]
    station = scenario_parameters(scenario).stations[1]
    true = transform_points(invert(np.array(station.T_station1_station)), _true_points(world, mine))
    horizontal, zenith, slope = (
        np.array([getattr(m, name) for m in mine])
        for name in ("horizontal_angle_rad", "zenith_angle_rad", "slope_distance_m")
    )
    distance = corrected_distance(slope, constant_m=station.prism_constant_m, ppm=0.0)
    error = polar_to_cartesian(horizontal, zenith, distance) - true
    sight = true / np.linalg.norm(true, axis=1, keepdims=True)
    across = np.cross(sight, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axis = {"along": sight, "across": across, "up": np.cross(across, sight)}[direction]
    seen = np.sum(error * axis, axis=1)
    expected = sigma_m * (1.0 if noise.range_sigma_mm or noise.pointing_sigma_mm else distance.mean())
    assert seen.std() == pytest.approx(expected, rel=0.07)
    assert abs(seen.mean()) < 4 * expected / math.sqrt(len(seen))


def test_rate_and_phase() -> None:
    """Each station measures every 400 ms, from an instant of its own in the first period."""
    _, measurements = _measure(ScenarioConfig())
    phases = set()
    for station in (1, 2, 3):
        stamps = [m.stamp_ns for m in measurements if m.station == station]
        assert {b - a for a, b in itertools.pairwise(stamps)} <= {399_999_999, 400_000_000, 400_000_001}
        assert 0 <= stamps[0] - START_NS < 400_000_000
        phases.add(stamps[0])
    assert len(phases) == 3


def test_arrival() -> None:
    """Measurements come in order of arrival, 50 to 250 ms after they were made, and none after the end."""
    _, measurements = _measure(ScenarioConfig())
    received = [m.received_ns for m in measurements]
    assert received == sorted(received)
    assert received[-1] <= START_NS + 120 * 10**9
    delays_ms = np.array([(m.received_ns - m.stamp_ns) / 1e6 for m in measurements])
    assert 50 <= delays_ms.min() < 60
    assert 240 < delays_ms.max() <= 250


def test_sequence_numbers_have_no_gaps() -> None:
    """Each station numbers its measurements from 0."""
    _, measurements = _measure(ScenarioConfig())
    for station in (1, 2, 3):
        sequence = [m.sequence for m in measurements if m.station == station]
        assert sequence == list(range(len(sequence)))


def test_angles_are_those_of_an_instrument() -> None:
    """Horizontal angles lie on the circle from 0 to 2 pi."""
    _, measurements = _measure(ScenarioConfig())
    angles = [m.horizontal_angle_rad for m in measurements]
    assert min(angles) >= 0
    assert max(angles) < 2 * math.pi


def test_one_seed_is_one_set_of_measurements() -> None:
    """The same seed gives the same measurements, another one others."""
    assert _measure(ScenarioConfig(), 10.0)[1] == _measure(ScenarioConfig(), 10.0)[1]
    assert _measure(ScenarioConfig(), 10.0)[1] != _measure(ScenarioConfig(), 10.0, seed=2)[1]
