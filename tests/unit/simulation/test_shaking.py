"""Fast shaking of the robot: its size and band, its derivatives, and what it leaves alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.config import ScenarioConfig, ShakingConfig
from tsgt.geometry import log_so3
from tsgt.simulation.world import World, scenario_world

if TYPE_CHECKING:
    from numpy.typing import NDArray

DURATION_S = 40.0
PIVOT_M = np.array([0.21, -0.12, 0.43])
SHAKING = ShakingConfig()


def _world(*, shaken: bool) -> World:
    world = scenario_world(ScenarioConfig(), DURATION_S, np.random.default_rng(2))
    if shaken:
        world.shake(SHAKING, PIVOT_M, np.random.default_rng(7))
    return world


@pytest.fixture(scope="module")
def shaken() -> World:
    """Return the reference scenario with shaking."""
    return _world(shaken=True)


@pytest.fixture(scope="module")
def still() -> World:
    """Return the same without shaking."""
    return _world(shaken=False)


def _full_speed(world: World, times_s: NDArray[np.float64]) -> NDArray[np.bool_]:
    fast: NDArray[np.bool_] = np.linalg.norm(world.motion_at(times_s).velocity_mps, axis=1) > 0.6
    return fast


def test_motion_is_the_derivative_of_the_poses(shaken: World) -> None:
    """Velocity, acceleration, angular rate and angular acceleration match central differences."""
    times_s, h = np.random.default_rng(0).uniform(1.0, DURATION_S - 1.0, 200), 1e-5
    before, after = (shaken.pose_at(times_s + step) for step in (-h, h))
    motion, early, late = (shaken.motion_at(times_s + step) for step in (0.0, -h, h))
    np.testing.assert_array_equal(motion.rotation, shaken.pose_at(times_s)[:, :3, :3])
    np.testing.assert_allclose(motion.velocity_mps, (after - before)[:, :3, 3] / (2 * h), atol=1e-6)
    turn = log_so3(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    np.testing.assert_allclose(motion.angular_rate_radps, turn / (2 * h), atol=2e-6)
    for name, derivative in (
        ("velocity_mps", "acceleration_mps2"),
        ("angular_rate_radps", "angular_acceleration_radps2"),
    ):
        slope = (getattr(late, name) - getattr(early, name)) / (2 * h)
        # The second derivative of a cubic spline has kinks at the knots.
        np.testing.assert_allclose(getattr(motion, derivative), slope, atol=2e-2)


def test_size_at_the_pivot(shaken: World, still: World) -> None:
    """At full speed the pivot is accelerated by 1.5 m/s^2 and turned by 0.06 rad/s rms on each axis."""
    times_s = np.arange(1.0, DURATION_S - 1.0, 0.0017)
    times_s = times_s[_full_speed(still, times_s)]
    one, other = (world.motion_at(times_s).at_point(PIVOT_M) for world in (shaken, still))
    acceleration = one.acceleration_mps2 - other.acceleration_mps2
    np.testing.assert_allclose(np.sqrt(np.mean(acceleration**2, axis=0)), 1.5, rtol=0.08)
    rate = one.angular_rate_radps - other.angular_rate_radps
    np.testing.assert_allclose(np.sqrt(np.mean(rate**2, axis=0)), 0.06, rtol=0.08)


def test_band(shaken: World, still: World) -> None:
    """Nearly all power of the angular rate lies between 8 and 60 Hz."""
    times_s = np.arange(1.0, DURATION_S - 1.0, 0.002)
    rate = (shaken.motion_at(times_s).angular_rate_radps - still.motion_at(times_s).angular_rate_radps)[:, 0]
    power = np.abs(np.fft.rfft(rate)) ** 2
    frequency_hz = np.fft.rfftfreq(len(rate), 0.002)
    inside = (frequency_hz > 7.0) & (frequency_hz < 61.0)
    assert power[inside].sum() > 0.995 * power.sum()


def test_prisms_are_shaken_with_the_robot(shaken: World) -> None:
    """A prism stays where it is on the robot."""
    times_s = np.linspace(1.0, 20.0, 50)
    expected = shaken.motion_at(times_s).at_point(shaken.prisms_m[2]).position_m
    np.testing.assert_allclose(shaken.prism_at(times_s, 2), expected, atol=1e-12)


def test_stationary_robot_is_not_shaken(shaken: World, still: World) -> None:
    """Without speed the poses are those without shaking."""
    times_s = np.arange(1.0, DURATION_S - 1.0, 0.01)
    standing = np.linalg.norm(still.motion_at(times_s).velocity_mps, axis=1) < 1e-9
    times_s = times_s[np.convolve(standing, np.ones(101), mode="same") == 101]
    assert len(times_s) > 100
    np.testing.assert_allclose(shaken.pose_at(times_s), still.pose_at(times_s), atol=1e-9)
