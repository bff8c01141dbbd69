"""Ground truth: motion statistics of the reference scenario, smoothness, routes, occlusions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.config import MotionConfig, OcclusionConfig, ScenarioConfig
from tsgt.geometry import transform_points
from tsgt.simulation.world import STEP_S, World, draw_occlusions, scenario_world

if TYPE_CHECKING:
    from numpy.typing import NDArray

PRISMS = np.array([prism.position_m for prism in ScenarioConfig().prisms])
MOTION = MotionConfig()


def _world(seed: int = 0, duration_s: float = 600.0, motion: MotionConfig = MOTION) -> World:
    return World(motion, PRISMS, duration_s, np.random.default_rng(seed))


def _times(duration_s: float, step_s: float = 0.05) -> NDArray[np.float64]:
    return np.arange(0.0, duration_s, step_s)


@pytest.fixture(scope="module")
def hour() -> NDArray[np.float64]:
    """Poses of an hour at 20 Hz, (N, 4, 4)."""
    return _world(duration_s=3600.0).pose_at(_times(3600.0))


def _speeds(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ground speed in m/s at each pose."""
    velocity = np.gradient(poses[:, :2, 3], 0.05, axis=0)
    return np.hypot(velocity[:, 0], velocity[:, 1])


def test_speed_distribution_matches_the_scenario(hour: NDArray[np.float64]) -> None:
    """Speeds 0, 0.5, 1.0 and 1.5 m/s take shares of 3, 2, 3 and 2 tenths of the time."""
    speeds = _speeds(hour)
    shares = np.array([np.mean(np.abs(speeds - speed) < 0.05) for speed in MOTION.speeds_mps])
    np.testing.assert_allclose(shares / shares.sum(), [0.3, 0.2, 0.3, 0.2], atol=0.05)
    # What is left is time spent changing from one speed to another.
    assert shares.sum() > 0.8


def test_vibration_while_moving(hour: NDArray[np.float64]) -> None:
    """While moving, roll and pitch are 1.5 degrees rms each and heave is 20 mm rms."""
    moving = hour[_speeds(hour) > 0.45]
    roll, pitch = np.arctan2(moving[:, 2, 1], moving[:, 2, 2]), -np.arcsin(moving[:, 2, 0])
    for angle in (roll, pitch):
        assert math.degrees(math.sqrt(np.mean(angle**2))) == pytest.approx(1.5, rel=0.07)
    heave = moving[:, 2, 3] - MOTION.area_centre_m[2]
    assert math.sqrt(np.mean(heave**2)) == pytest.approx(0.020, rel=0.07)


def test_stationary_robot_is_still_and_level(hour: NDArray[np.float64]) -> None:
    """From 1.5 s after a stop the robot is still and level."""
    still = np.convolve(_speeds(hour) < 1e-3, np.ones(61), mode="same") == 61
    assert still.sum() > 1000
    np.testing.assert_allclose(hour[still, 2, 2], 1.0, atol=1e-6)
    np.testing.assert_allclose(hour[still, 2, 3], MOTION.area_centre_m[2], atol=1e-3)


def test_yaw_rates_match_the_scenario(hour: NDArray[np.float64]) -> None:
    """Turns are at 0.3 or 0.5 rad/s to either side, never faster."""
    yaw = np.unwrap(np.arctan2(hour[:, 1, 0], hour[:, 0, 0]))
    rates = np.gradient(yaw, 0.05)
    assert np.abs(rates).max() < 0.5 + 0.1  # pitch and roll add a little to what is seen from above
    for rate in (0.3, -0.3, 0.5, -0.5):
        assert np.mean(np.abs(rates - rate) < 0.01) > 0.02


def test_robot_stays_near_its_area(hour: NDArray[np.float64]) -> None:
    """The robot leaves the 40 m circle by no more than its turn takes, and uses most of it."""
    distance = np.hypot(*(hour[:, :2, 3] - MOTION.area_centre_m[:2]).T)
    assert distance.max() < MOTION.area_radius_m + 8.0
    assert distance.max() > MOTION.area_radius_m - 5.0


def test_velocity_is_along_the_x_axis(hour: NDArray[np.float64]) -> None:
    """The velocity points along the robot's x axis."""
    velocity = np.gradient(hour[:, :3, 3], 0.05, axis=0)
    fast = _speeds(hour) > 0.4
    sideways = np.sum(velocity[fast] * hour[fast, :3, 1], axis=1)
    assert np.abs(sideways).max() < 0.06


def test_poses_are_rigid(hour: NDArray[np.float64]) -> None:
    """Every hundredth pose is a proper rigid transform."""
    rotation = hour[::100, :3, :3]
    identity = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation.swapaxes(1, 2) @ rotation, identity, atol=1e-6)
    assert (np.linalg.det(rotation) > 0).all()
    assert (hour[::100, 3] == (0.0, 0.0, 0.0, 1.0)).all()


def test_truth_is_smooth_between_grid_points() -> None:
    """Over a millisecond a prism moves according to velocity and acceleration, to a micrometre."""
    start = np.arange(1.0, 59.0, STEP_S / 3)
    world = _world(3, 60.0)
    before, here, after = (world.prism_at(start + shift, 1) for shift in (-1e-3, 0.0, 1e-3))
    bend = after - 2 * here + before
    assert np.linalg.norm(bend, axis=1).max() < 5e-6  # 5 m/s^2 over 1 ms
    assert np.linalg.norm(np.diff(bend, axis=0), axis=1).max() < 1e-6


def test_same_seed_gives_the_same_world() -> None:
    """Another seed gives another world."""
    times = _times(60.0)
    poses = _world(5, 60.0).pose_at(times)
    np.testing.assert_array_equal(poses, _world(5, 60.0).pose_at(times))
    assert np.abs(poses - _world(6, 60.0).pose_at(times)).max() > 0.1


def test_pose_does_not_depend_on_other_queried_instants() -> None:
    """An instant has the same pose whether queried alone or among others."""
    world, times = _world(duration_s=20.0), _times(20.0, 0.013)
    together = world.pose_at(times)
    np.testing.assert_array_equal(together[777], world.pose_at(times[777:778])[0])


def test_prism_positions_follow_the_pose() -> None:
    """A prism is at its robot-frame position transformed by the pose."""
    world, times = _world(duration_s=20.0), _times(20.0)
    np.testing.assert_allclose(
        world.prism_at(times, 2), transform_points(world.pose_at(times), PRISMS[2]), atol=1e-12
    )


@pytest.mark.parametrize("time_s", [-0.001, 20.001, math.nan])
def test_instant_outside_the_covered_time_is_rejected(time_s: float) -> None:
    """There is no extrapolation; NaN is rejected too."""
    with pytest.raises(ValueError, match="the ground truth covers 0 to 20"):
        _world(duration_s=20.0).pose_at(np.array([1.0, time_s]))


def test_first_and_last_instant_are_covered() -> None:
    """Also for a duration that is no whole number of steps."""
    world = _world(duration_s=7.013)
    assert np.isfinite(world.pose_at(np.array([0.0, 7.013]))).all()


def test_robot_with_zero_speed_stays_level() -> None:
    """With the only speed 0 the robot stays at its start."""
    world = _world(duration_s=30.0, motion=MotionConfig(speeds_mps=(0.0,), speed_weights=(1.0,)))
    poses = world.pose_at(_times(30.0))
    np.testing.assert_allclose(poses[:, :3, 3], np.tile(MOTION.area_centre_m, (len(poses), 1)), atol=1e-12)
    np.testing.assert_allclose(poses[:, 2, 2], 1.0, atol=1e-15)


# ------------------------------------------------------------------------------------------------------ routes

ROUTE = MotionConfig(route_m=((0.0, 0.0, 0.0), (30.0, 0.0, 3.0), (30.0, 40.0, 3.0)))


@pytest.mark.parametrize("route", [(), ((5.0, 5.0, 0.0), (300.0, 5.0, 0.0))])
def test_start_delay_is_respected(route: tuple[tuple[float, float, float], ...]) -> None:
    """With and without a route the robot is still before ``start_after_s`` and moves soon after."""
    motion = MotionConfig(start_after_s=30.0, speeds_mps=(1.0,), speed_weights=(1.0,), route_m=route)
    position = _world(duration_s=60.0, motion=motion).pose_at(np.array([0.0, 28.0, 33.0]))[:, :3, 3]
    assert np.linalg.norm(position[1] - position[0]) < 1e-6
    assert np.linalg.norm(position[2] - position[0]) > 1.0


def test_route_is_driven_to_its_end() -> None:
    """The robot starts at the first waypoint, and stops at the last one."""
    poses = _world(duration_s=300.0, motion=ROUTE).pose_at(np.array([0.0, 299.0, 300.0]))
    # The smoothing of corners and of speeds takes a little off both ends.
    np.testing.assert_allclose(poses[0, :2, 3], (0.0, 0.0), atol=2.0)
    np.testing.assert_allclose(poses[1, :2, 3], (30.0, 40.0), atol=2.0)
    np.testing.assert_allclose(poses[1], poses[2], atol=1e-6)


def test_robot_stays_on_its_route() -> None:
    """The robot leaves the route only at its rounded corners and never reverses."""
    position = _world(duration_s=300.0, motion=ROUTE).pose_at(_times(300.0))[:, :3, 3]
    to_first_leg = np.abs(position[:, 1])
    to_second_leg = np.abs(position[:, 0] - 30.0)
    assert np.minimum(to_first_leg, to_second_leg).max() < 1.5
    assert np.diff(position[:, 0] + position[:, 1]).min() > -1e-3


def test_heading_and_pitch_follow_the_route() -> None:
    """The robot's x axis is tangential to the route, upward where it climbs."""
    poses = _world(duration_s=300.0, motion=ROUTE.model_copy(update={"tilt_rms_deg": 0.0})).pose_at(
        _times(300.0)
    )
    climbing = (poses[:, 0, 3] > 10.0) & (poses[:, 0, 3] < 20.0)
    along = np.array([30.0, 0.0, 3.0]) / math.hypot(30.0, 3.0)
    np.testing.assert_allclose(poses[climbing, :3, 0], np.tile(along, (climbing.sum(), 1)), atol=1e-3)


def test_route_speeds_match_the_scenario() -> None:
    """On a straight route the robot drives at the configured speeds."""
    motion = MotionConfig(route_m=((0.0, 0.0, 0.0), (1000.0, 0.0, 0.0)), heave_rms_mm=0.0)
    speeds = _speeds(_world(duration_s=600.0, motion=motion).pose_at(_times(600.0)))
    shares = [np.mean(np.abs(speeds - speed) < 0.02) for speed in motion.speeds_mps]
    assert sum(shares) > 0.75
    assert min(shares) > 0.05


# -------------------------------------------------------------------------------------------------- occlusions

TREES = OcclusionConfig(rate_per_min=3.0, duration_min_s=1.0, duration_max_s=2.0)
BENDS = OcclusionConfig(rate_per_min=1.0, duration_min_s=5.0, duration_max_s=10.0, common=True)


def test_occlusion_rate_and_durations_match_the_scenario() -> None:
    """Three per minute give 1800 in ten hours, each within the limits."""
    spans = draw_occlusions([TREES], [1], 36_000.0, np.random.default_rng(0))[1]
    assert len(spans) == pytest.approx(1800, abs=150)
    lengths = spans[:, 1] - spans[:, 0]
    assert lengths.min() >= 1.0
    assert lengths.max() <= 2.0


def test_common_occlusions_affect_all_stations() -> None:
    """Common occlusions coincide at all stations, the others are independent."""
    spans = draw_occlusions([TREES, BENDS], [1, 2], 3600.0, np.random.default_rng(0))
    one, other = ({tuple(span) for span in spans[station].tolist()} for station in (1, 2))
    common = one & other
    assert len(common) == pytest.approx(60, abs=25)
    assert all(to - since >= 5.0 for since, to in common)
    assert all(to - since <= 2.0 for since, to in (one | other) - common)


def test_occlusions_do_not_change_the_motion() -> None:
    """The same seed gives the same motion with and without occlusions."""
    scenario = ScenarioConfig()
    times = _times(30.0)
    open_world = scenario_world(scenario, 30.0, np.random.default_rng(4))
    forest = scenario.model_copy(update={"occlusions": (TREES, BENDS)})
    forest_world = scenario_world(forest, 30.0, np.random.default_rng(4))
    np.testing.assert_array_equal(open_world.pose_at(times), forest_world.pose_at(times))
