"""The simulated total station: what it measures is the truth plus the noise stated, at its own instants."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.config import MotionConfig, NoiseConfig, ScenarioConfig, scenario_parameters
from tsgt.config.scenario import StatusFaultConfig
from tsgt.geometry import corrected_distance, invert, polar_to_cartesian, transform_points
from tsgt.model import Status
from tsgt.simulation.clocks import DriftingClock, VirtualClock
from tsgt.simulation.instrument import SimulatedInstrument
from tsgt.simulation.world import World, scenario_world

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.clock import Clock
    from tsgt.station.instrument import Reading

SILENT = NoiseConfig(range_sigma_mm=0.0, range_sigma_ppm=0.0, angle_sigma_arcsec=0.0, pointing_sigma_mm=0.0)
CLOCK = VirtualClock(0)


def with_noise(noise: NoiseConfig, **changes: object) -> ScenarioConfig:
    """Return the reference scenario with other noise."""
    stations = tuple(s.model_copy(update={"noise": noise}) for s in ScenarioConfig().stations)
    return ScenarioConfig().model_copy(update={"stations": stations, **changes})


def make(
    scenario: ScenarioConfig, station: int, *, duration_s: float = 100.0, clock: Clock = CLOCK
) -> tuple[World, SimulatedInstrument]:
    """Make a world and one of its instruments."""
    world = scenario_world(scenario, duration_s, np.random.default_rng(1))
    entry = scenario.stations[station - 1]
    return world, SimulatedInstrument(entry, scenario, world, clock, np.random.default_rng(station))


async def track(instrument: SimulatedInstrument, prism: int, count: int) -> list[Reading]:
    """Read so many times."""
    await instrument.connect()
    await instrument.track(prism)
    return [await instrument.read() for _ in range(count)]


def columns(readings: list[Reading]) -> tuple[NDArray[np.float64], ...]:
    """Horizontal and zenith angles and raw distances."""
    return (
        np.array([reading.horizontal_angle_rad for reading in readings]),
        np.array([reading.zenith_angle_rad for reading in readings]),
        np.array([reading.slope_distance_m for reading in readings], dtype=np.float64),
    )


@pytest.mark.parametrize("station", [1, 2, 3])
async def test_without_noise_it_measures_the_truth(station: int) -> None:
    """Constant and frame are exactly undone by the way that every real measurement takes."""
    scenario = with_noise(SILENT)
    world, instrument = make(scenario, station)
    readings = await track(instrument, station, 50)
    parameters = scenario_parameters(scenario).stations[station - 1]
    horizontal, zenith, slope = columns(readings)
    distance = corrected_distance(slope, constant_m=parameters.prism_constant_m, ppm=0.0)
    points = transform_points(
        np.array(parameters.T_station1_station), polar_to_cartesian(horizontal, zenith, distance)
    )
    true = world.prism_at(np.array([reading.at_ns / 1e9 for reading in readings]), station - 1)
    np.testing.assert_allclose(points, true, atol=1e-9)
    assert slope == pytest.approx(np.linalg.norm(true - parameters_origin(parameters), axis=1) - 0.010)


def parameters_origin(parameters: object) -> NDArray[np.float64]:
    """Where a station stands in frame ``station1``."""
    return np.array(parameters.T_station1_station)[:3, 3]  # type: ignore[attr-defined]


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
async def test_noise_is_as_large_as_stated(noise: NoiseConfig, direction: str, sigma_m: float) -> None:
    """Each part of the noise acts in its direction with its sigma; angles and ppm grow with the distance."""
    still = MotionConfig(speeds_mps=(0.0,), speed_weights=(1.0,), area_centre_m=(60.0, 45.0, 60.0))
    scenario = with_noise(noise, motion=still)
    world, instrument = make(scenario, 2, duration_s=1.0)
    horizontal, zenith, slope = columns(await track(instrument, 2, 2500))
    station = scenario_parameters(scenario).stations[1]
    true = transform_points(invert(np.array(station.T_station1_station)), world.prism_at(np.array([0.5]), 1))
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


async def test_rate_and_phase() -> None:
    """Each station measures every 400 ms, from an instant of its own in the first period."""
    phases = set()
    for station in (1, 2, 3):
        _, instrument = make(ScenarioConfig(), station)
        began_ns = CLOCK.monotonic_ns()
        stamps = [reading.at_ns for reading in await track(instrument, station, 5)]
        assert np.diff(stamps).tolist() == [400_000_000] * 4
        assert 0 <= stamps[0] - began_ns < 400_000_000
        phases.add(stamps[0] - began_ns)
    assert len(phases) == 3


async def test_stamps_are_those_of_the_hosts_clock() -> None:
    """On a clock that runs fast the robot is seen where it is, not where the clock would have it."""
    clock = DriftingClock(VirtualClock(0), drift_ppm=1000.0)
    scenario = with_noise(SILENT)
    world, instrument = make(scenario, 1, clock=clock)
    reading = (await track(instrument, 1, 150))[-1]
    assert reading.at_ns == pytest.approx(60e9, abs=1e9)
    true_s = clock.true_ns(reading.at_ns) / 1e9
    assert reading.at_ns / 1e9 - true_s == pytest.approx(0.06, rel=0.05)
    distance_m = np.linalg.norm(world.prism_at(np.array([true_s]), 0)[0])
    assert reading.slope_distance_m == pytest.approx(distance_m - 0.010, abs=1e-6)


@pytest.mark.parametrize(
    ("status", "raw"), [("tilt", 1), ("wrong_distance", 2), ("no_target", 3), ("angle_only", 4)]
)
async def test_faults_come_and_go_at_their_times(status: str, raw: int) -> None:
    """Between the given times the status is what the fault says; there is no distance then."""
    fault = StatusFaultConfig(station=1, status=status, start_s=2.0, end_s=4.0)  # type: ignore[arg-type]
    _, instrument = make(ScenarioConfig(faults=(fault,)), 1)
    for reading in await track(instrument, 1, 20):
        if 2.0 <= reading.at_ns / 1e9 < 4.0:
            assert (reading.status, reading.raw_status) == (Status(status), raw)
            assert reading.slope_distance_m is None
            assert (reading.horizontal_angle_rad != 0.0) == (status == "angle_only")
        else:
            assert reading.status is Status.OK


async def test_another_station_has_no_fault() -> None:
    """A fault is one instrument's."""
    fault = StatusFaultConfig(station=1, status="tilt", start_s=0.0, end_s=60.0)
    _, instrument = make(ScenarioConfig(faults=(fault,)), 2)
    assert {reading.status for reading in await track(instrument, 2, 5)} == {Status.OK}


async def test_too_close_gives_angles_alone() -> None:
    """Below a metre there is no distance."""
    still = MotionConfig(speeds_mps=(0.0,), speed_weights=(1.0,), area_centre_m=(0.5, 0.0, -1.0))
    _, instrument = make(ScenarioConfig(motion=still), 1)
    (reading,) = await track(instrument, 1, 1)
    assert (reading.status, reading.slope_distance_m) == (Status.ANGLE_ONLY, None)


async def test_a_hidden_prism_is_no_target() -> None:
    """What stands in between takes the target away, for as long as it stands there."""
    scenario = ScenarioConfig()
    world = World(
        scenario.motion,
        np.array([prism.position_m for prism in scenario.prisms]),
        60.0,
        np.random.default_rng(1),
        {1: np.array([[1.0, 3.0]])},
    )
    instrument = SimulatedInstrument(scenario.stations[0], scenario, world, CLOCK, np.random.default_rng(2))
    for reading in await track(instrument, 1, 15):
        hidden = 1.0 <= reading.at_ns / 1e9 < 3.0
        assert reading.status is (Status.NO_TARGET if hidden else Status.OK)


async def test_after_its_end_the_world_stands_still() -> None:
    """An instrument may be read for longer than there is a truth."""
    _, instrument = make(with_noise(SILENT), 1, duration_s=1.0)
    readings = await track(instrument, 1, 10)
    assert len({reading.slope_distance_m for reading in readings[5:]}) == 1
