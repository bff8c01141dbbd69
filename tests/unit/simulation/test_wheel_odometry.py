"""Wheel odometry: true speed and yaw rate, scale error, slip that lasts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tsgt.config import ScenarioConfig
from tsgt.simulation.imu import Silence, StuckValues
from tsgt.simulation.wheel_odometry import OdometryModel, WheelSlip, simulate_odometry
from tsgt.simulation.world import World, scenario_world

EXACT = OdometryModel(scale_error=0.0, slip=0.0, speed_noise_mps=0.0, yaw_rate_noise_radps=0.0)
UNTIL_S = 300.0


@cache
def _world() -> World:
    return scenario_world(ScenarioConfig(), UNTIL_S, np.random.default_rng(2))


def test_exact_odometry_integrates_to_the_path() -> None:
    """The integral of the speed is the length of the driven path, and that of the yaw rate the change of heading."""
    found = simulate_odometry(replace(EXACT, rate_hz=200.0), _world().motion_at, 60.0, seed=[1])
    poses = _world().pose_at(found.time_s)
    path_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    # Heave is across the x axis.
    assert np.trapezoid(found.speed_mps, found.time_s) == pytest.approx(path_m, rel=0.005)
    heading = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    turned = np.trapezoid(found.yaw_rate_radps, found.time_s)
    assert turned == pytest.approx(heading[-1] - heading[0], abs=0.02)


def test_slip_lasts() -> None:
    """Slip is 3 % and correlated over 5 s: by 1/e from one sample to the one 5 s later."""
    model = replace(EXACT, slip=0.03, rate_hz=20.0)

    def driving(times_s: np.ndarray) -> object:
        motion = _world().motion_at(np.minimum(times_s, UNTIL_S))
        speed = np.zeros_like(motion.velocity_mps)
        speed[:, 0] = 1.0
        return replace(motion, velocity_mps=speed, rotation=np.broadcast_to(np.eye(3), motion.rotation.shape))

    slip = simulate_odometry(model, driving, 4000.0, seed=[1]).speed_mps - 1.0  # type: ignore[arg-type]
    assert slip.std() == pytest.approx(0.03, rel=0.1)
    assert np.corrcoef(slip[100:], slip[:-100])[0, 1] == pytest.approx(np.exp(-1), abs=0.1)


def test_noise_and_determinism() -> None:
    """A stationary robot shows the noise alone; another seed shows another one."""
    model = replace(EXACT, speed_noise_mps=0.01, yaw_rate_noise_radps=0.02)
    one, same, other = (simulate_odometry(model, _world().motion_at, 200.0, seed=[n]) for n in (1, 1, 2))
    np.testing.assert_array_equal(one.speed_mps, same.speed_mps)
    assert not np.array_equal(one.speed_mps[:100], other.speed_mps[:100])
    true = simulate_odometry(EXACT, _world().motion_at, 200.0, seed=[1])
    assert (one.speed_mps - true.speed_mps).std() == pytest.approx(0.01, rel=0.05)
    assert (one.yaw_rate_radps - true.yaw_rate_radps).std() == pytest.approx(0.02, rel=0.05)


def test_conditions_change_their_time_alone() -> None:
    """Silent wheels count on; stuck ones repeat the last value; those that spin show a multiple of the speed."""
    conditions = (Silence(10.0, 2.0), StuckValues(20.0, 3.0), WheelSlip(30.0, 1.0, 1.5))
    sound = simulate_odometry(OdometryModel(), _world().motion_at, 40.0, seed=[1])
    found = simulate_odometry(OdometryModel(), _world().motion_at, 40.0, seed=[1], conditions=conditions)
    assert found.counter[0] == 0
    assert found.counter[-1] == len(sound.time_s) - 1
    silent = (sound.time_s >= 10.0) & (sound.time_s < 12.0)
    np.testing.assert_array_equal(found.time_s, sound.time_s[~silent])
    expected = sound.speed_mps.copy()
    stuck = (sound.time_s >= 20.0) & (sound.time_s < 23.0)
    expected[stuck] = expected[np.flatnonzero(stuck)[0] - 1]
    expected[(sound.time_s >= 30.0) & (sound.time_s < 31.0)] *= 1.5
    np.testing.assert_array_equal(found.speed_mps, expected[~silent])
