"""Simulated IMU: analytic motions, integration back to the motion, noise, biases, clock and determinism."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.config import ScenarioConfig, ShakingConfig, SimulatedImu
from tsgt.geometry import exp_so3
from tsgt.simulation.imu import (
    IMU_MODELS,
    Environment,
    Mounting,
    SimulatedImuRun,
    ideal_samples,
    mounting_of,
    simulate_imu,
)
from tsgt.simulation.rigid_motion import RigidMotion
from tsgt.simulation.world import World, scenario_world

if TYPE_CHECKING:
    from numpy.typing import NDArray

G = 9.81
FLAT = Environment(np.array([0.0, 0.0, -G]), np.zeros(3))
AT_ORIGIN = Mounting(np.eye(3), np.zeros(3))
END_S: NDArray[np.float64] = np.arange(0.005, 1.0025, 0.005)
DURATION_S = np.full(200, 0.005)
CONFIG = SimulatedImu(model="industrial")


def _turning(rate_radps: NDArray[np.float64], times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    return exp_so3(times_s[:, None] * rate_radps)


def _at_rest(times_s: NDArray[np.float64]) -> RigidMotion:
    zero = np.zeros((len(times_s), 3))
    return RigidMotion(np.broadcast_to(np.eye(3), (len(zero), 3, 3)), zero, zero, zero, zero, zero)


def _constant_turn(rate_radps: NDArray[np.float64], times_s: NDArray[np.float64]) -> RigidMotion:
    still = _at_rest(times_s)
    zero = still.position_m
    return RigidMotion(_turning(rate_radps, times_s), zero, zero, zero, zero + rate_radps, zero)


def test_at_rest_the_specific_force_points_up() -> None:
    """Without rotation of the Earth, a level IMU measures +g on z and no rate."""
    found = ideal_samples(_at_rest, FLAT, [(0.0, AT_ORIGIN)], END_S, DURATION_S)
    np.testing.assert_allclose(found.angular_rate_radps, 0.0, atol=1e-15)
    np.testing.assert_allclose(found.specific_force_mps2, np.tile([0.0, 0.0, G], (200, 1)), atol=1e-12)


def test_free_fall_has_no_specific_force() -> None:
    """A falling robot is weightless, wherever the IMU is on it."""

    def falling(times_s: NDArray[np.float64]) -> RigidMotion:
        still = _at_rest(times_s)
        gravity = np.tile(FLAT.gravity_mps2, (len(times_s), 1))
        return RigidMotion(
            still.rotation,
            0.5 * gravity * times_s[:, None] ** 2,
            gravity * times_s[:, None],
            gravity,
            still.angular_rate_radps,
            still.angular_acceleration_radps2,
        )

    mounting = Mounting(exp_so3(np.array([0.3, -0.2, 1.0])), np.array([0.5, 0.1, 0.2]))
    found = ideal_samples(falling, FLAT, [(0.0, mounting)], END_S, DURATION_S)
    np.testing.assert_allclose(found.specific_force_mps2, 0.0, atol=1e-12)


def test_circle_by_lever_arm() -> None:
    """On a turntable the force is w^2 r towards the axis and g upwards, in the axes of the IMU."""
    rate = np.array([0.0, 0.0, 2.0])
    mounting = Mounting(exp_so3(np.array([0.0, 0.0, math.pi / 2])), np.array([0.3, 0.0, 0.1]))
    found = ideal_samples(
        lambda times_s: _constant_turn(rate, times_s), FLAT, [(0.0, mounting)], END_S, DURATION_S
    )
    # The robot's -x axis is the IMU's +y axis.
    np.testing.assert_allclose(found.specific_force_mps2, np.tile([0.0, 1.2, G], (200, 1)), atol=1e-12)
    np.testing.assert_allclose(found.angular_rate_radps, np.tile(rate, (200, 1)), atol=1e-12)


def test_tilted_turn_rotates_gravity() -> None:
    """Rolling about x at 1 rad/s, gravity goes through y and z as its mean over each interval."""
    rate = np.array([1.0, 0.0, 0.0])
    found = ideal_samples(
        lambda times_s: _constant_turn(rate, times_s), FLAT, [(0.0, AT_ORIGIN)], END_S, DURATION_S
    )
    start_s = END_S - 0.005
    mean_y = G * (np.cos(start_s) - np.cos(END_S)) / 0.005
    mean_z = G * (np.sin(END_S) - np.sin(start_s)) / 0.005
    expected = np.stack([np.zeros(200), mean_y, mean_z], axis=1)
    np.testing.assert_allclose(found.specific_force_mps2, expected, atol=1e-10)


def test_earth_rate_and_coriolis() -> None:
    """A robot that drives north at the pole measures the Earth's rate on z and is pushed to the left by 2 W v."""
    earth = Environment(FLAT.gravity_mps2, np.array([0.0, 0.0, 7.292115e-5]))

    def driving(times_s: NDArray[np.float64]) -> RigidMotion:
        still = _at_rest(times_s)
        velocity = np.tile([10.0, 0.0, 0.0], (len(times_s), 1))
        zero = still.position_m
        return RigidMotion(still.rotation, velocity * times_s[:, None], velocity, zero, zero, zero)

    found = ideal_samples(driving, earth, [(0.0, AT_ORIGIN)], END_S, DURATION_S)
    np.testing.assert_allclose(found.angular_rate_radps[:, 2], 7.292115e-5, rtol=1e-12)
    np.testing.assert_allclose(found.specific_force_mps2[:, 1], 20 * 7.292115e-5, rtol=1e-9)


@cache
def _world(*, shaken: bool = False) -> World:
    world = scenario_world(ScenarioConfig(), 70.0, np.random.default_rng(2))
    if shaken:
        world.shake(ShakingConfig(), np.array(CONFIG.position_m), np.random.default_rng(2))
    return world


@pytest.mark.parametrize("shaken", [False, True])
def test_double_integration_returns_the_motion(*, shaken: bool) -> None:
    """Integrated in small steps, ideal samples lead from pose and velocity to the pose a second later."""
    world, mounting = _world(shaken=shaken), mounting_of(CONFIG)
    earth = Environment(
        np.array([1e-4, 2e-4, -9.8075]), 7.292115e-5 * np.array([0.6, -0.3, math.sqrt(1 - 0.45)])
    )
    steps, step_s, start_s = 5_000, 2e-4, 10.0
    end_s = start_s + step_s * np.arange(1.0, steps + 1)
    samples = ideal_samples(world.motion_at, earth, [(0.0, mounting)], end_s, np.full(steps, step_s))
    truth = world.motion_at(np.array([start_s, end_s[-1]])).at_point(mounting.position_m)
    R = truth.rotation[0] @ mounting.R_robot_imu
    # Against inertial space the axes turn by the rate; frame station1 turns below them.
    turns = exp_so3(samples.angular_rate_radps * step_s)
    back = exp_so3(-earth.earth_rate_radps * step_s)
    p, v = truth.position_m[0].copy(), truth.velocity_mps[0].copy()
    for turn, force in zip(turns, samples.specific_force_mps2, strict=True):
        following = back @ R @ turn
        acceleration = 0.5 * (R + following) @ force + earth.gravity_mps2
        acceleration = acceleration - 2.0 * np.cross(earth.earth_rate_radps, v)
        p, v, R = p + v * step_s + 0.5 * acceleration * step_s**2, v + acceleration * step_s, following
    np.testing.assert_allclose(p, truth.position_m[1], atol=1e-6)
    np.testing.assert_allclose(R, truth.rotation[1] @ mounting.R_robot_imu, atol=1e-8)


@cache
def _still_minute(name: str) -> SimulatedImuRun:
    config = CONFIG.model_copy(update={"model": name})
    return simulate_imu(config, _at_rest, 120.0, seed=[3])


@pytest.mark.parametrize("name", ["industrial", "consumer"])
def test_noise_density_at_two_averaging_times(name: str) -> None:
    """The Allan deviation of what is left without bias is density / sqrt(tau), at 20 ms and at 0.5 s."""
    run, noise = _still_minute(name), IMU_MODELS[name].noise
    left = (
        (run.samples.angular_rate_radps - run.truth.gyro_bias_radps, noise.gyro_noise_density),
        (
            run.samples.specific_force_mps2 - run.truth.accelerometer_bias_mps2,
            noise.accelerometer_noise_density,
        ),
    )
    for values, density in left:
        for size in (4, 100):
            blocks = len(values) // size
            means = values[: blocks * size].reshape(blocks, size, 3).mean(axis=1)
            allan = np.sqrt(np.mean(np.diff(means, axis=0) ** 2) / 2)
            assert allan == pytest.approx(density / math.sqrt(size * 0.005), rel=0.12)


def test_bias_walk() -> None:
    """The variance of the bias's change over a second is that of the walk."""
    run, noise = _still_minute("industrial"), IMU_MODELS["industrial"].noise
    change = run.truth.gyro_bias_radps[200::200] - run.truth.gyro_bias_radps[:-200:200]
    assert np.sqrt(np.mean(change**2)) == pytest.approx(noise.gyro_bias_walk, rel=0.15)


def test_matrix_and_g_sensitivity_of_the_device() -> None:
    """At rest the mean specific force is that of the device's matrix, and gravity reaches the gyro."""
    run = _still_minute("consumer")
    truth = run.truth
    R = truth.mounting.R_robot_imu
    expected = truth.accelerometer_matrix @ R.T @ -truth.gravity_mps2 + truth.accelerometer_bias_mps2.mean(
        axis=0
    )
    np.testing.assert_allclose(run.samples.specific_force_mps2.mean(axis=0), expected, atol=2e-3)


def test_device_clock_gives_the_durations() -> None:
    """On the device's clock intervals are 5 ms; in truth its skew makes them shorter or longer by less than 200 ppm."""
    run = _still_minute("industrial")
    assert np.diff(run.samples.device_ns).tolist() == [5_000_000] * (len(run.samples) - 1)
    np.testing.assert_allclose(run.samples.duration_s, 0.005, rtol=2e-4)
    assert abs(run.samples.duration_s.mean() / 0.005 - 1) > 1e-7
    np.testing.assert_allclose(np.diff(run.samples.end_s), run.samples.duration_s[1:], atol=1e-12)


def test_arrivals_follow_the_latency() -> None:
    """Nothing arrives before its latency, most within a millisecond, all in order; stalls make bursts."""
    samples, latency_s = _still_minute("industrial").samples, 4.3e-3
    delay_s = samples.arrival_s - samples.end_s - latency_s
    assert delay_s.min() >= 0
    assert delay_s.min() < 5e-5
    assert np.median(delay_s) < 1e-3
    assert delay_s.max() > 5e-3
    assert np.diff(samples.arrival_s).min() >= 0


def test_same_seed_gives_the_same_samples_and_another_the_same_device() -> None:
    """Scale factors and misalignment belong to the serial number, biases and noise to the seed."""
    one, same, other = (simulate_imu(CONFIG, _at_rest, 2.0, seed=[seed]) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.samples.angular_rate_radps, same.samples.angular_rate_radps)
    np.testing.assert_array_equal(one.samples.arrival_s, same.samples.arrival_s)
    assert np.abs(one.samples.angular_rate_radps[:300] - other.samples.angular_rate_radps[:300]).max() > 1e-4
    np.testing.assert_array_equal(one.truth.gyro_matrix, other.truth.gyro_matrix)
    another = simulate_imu(CONFIG.model_copy(update={"serial_number": 6}), _at_rest, 2.0, seed=[3])
    assert np.abs(one.truth.gyro_matrix - another.truth.gyro_matrix).max() > 1e-5


def test_samples_are_the_true_motion_plus_bias() -> None:
    """With the gyro matrix applied, samples of a shaken drive are the ideal ones, up to noise and bias."""
    world = _world(shaken=True)
    run = simulate_imu(CONFIG, world.motion_at, 60.0, seed=[3])
    found, truth = run.samples.select(np.argsort(run.samples.end_s, kind="stable")), run.truth
    earth = Environment(truth.gravity_mps2, truth.earth_rate_radps)
    ideal = ideal_samples(world.motion_at, earth, [(0.0, truth.mounting)], found.end_s, found.duration_s)
    left = (found.angular_rate_radps - truth.gyro_bias_radps) @ np.linalg.inv(truth.gyro_matrix).T
    left -= ideal.angular_rate_radps
    expected = truth.noise.gyro_noise_density / math.sqrt(0.005)
    np.testing.assert_allclose(left.std(axis=0), expected, rtol=0.05)
