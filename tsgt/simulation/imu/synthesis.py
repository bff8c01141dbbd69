"""Samples of an IMU on a moving robot: exact motion, then the errors of the device."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import exp_so3, log_so3, rotate, rotation_from_quaternion
from tsgt.geometry.inertial import InertialSamples
from tsgt.simulation.imu.arrival import draw_arrivals
from tsgt.simulation.imu.conditions import Knock, apply_conditions, apply_setup_errors, configured_parameters
from tsgt.simulation.imu.device import SWITCHED_ON_S, ImuDevice
from tsgt.simulation.imu.environment import draw_environment
from tsgt.simulation.imu.presets import IMU_MODELS
from tsgt.simulation.imu.samples import DeviceSamples, ImuTruth, Mounting, SimulatedImuRun

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from tsgt.config import SimulatedImu
    from tsgt.simulation.imu.conditions import ImuCondition
    from tsgt.simulation.imu.environment import Environment
    from tsgt.simulation.rigid_motion import RigidMotion

    MotionAt = Callable[[NDArray[np.float64]], RigidMotion]

_NODES, _WEIGHTS = (each / 2 for each in np.polynomial.legendre.leggauss(4))
KNOCK_S = 0.02
"""How long the IMU moves when it is knocked: a shock by a stone or a boot."""

_BLOCK = 4096  # samples at once, which bounds memory


def mounting_of(config: SimulatedImu) -> Mounting:
    """Return where the IMU of a scenario is."""
    quaternion = np.array(config.orientation_xyzw)
    return Mounting(
        rotation_from_quaternion(quaternion / np.linalg.norm(quaternion)), np.array(config.position_m)
    )


def simulate_imu(
    config: SimulatedImu,
    motion_at: MotionAt,
    until_s: float,
    *,
    seed: Sequence[int],
    conditions: Sequence[ImuCondition] = (),
) -> SimulatedImuRun:
    """Simulate the IMU of a scenario from the start of a mission to ``until_s``; ``motion_at`` covers this time."""
    environment_rng, bias_rng, noise_rng, arrival_rng, condition_rng = np.random.default_rng(
        [*seed, 0x1A]
    ).spawn(5)
    device = ImuDevice.drawn(IMU_MODELS[config.model], config.serial_number)
    environment = draw_environment(config, environment_rng)
    mounting, latency_s = mounting_of(config), config.latency_ms / 1e3
    period_s = 1.0 / device.model.rate_hz
    phase_s = arrival_rng.uniform(0.0, period_s)
    count = int((until_s - phase_s - latency_s) * (1 - 1e-3) / period_s)
    clock_s = phase_s + np.arange(count + 1, dtype=np.float64) * period_s
    bounds_s = device.true_s(clock_s)
    end_s, duration_s = bounds_s[1:], np.diff(bounds_s)
    knocks = [each for each in conditions if isinstance(each, Knock)]
    ideal = ideal_samples(motion_at, environment, _mountings(mounting, knocks), end_s, duration_s)
    rate, force, gyro_bias, accelerometer_bias = _measured(device, ideal, bias_rng, noise_rng)
    resolution_ns = device.model.clock_resolution_ns
    samples = DeviceSamples(
        np.arange(count, dtype=np.int64),
        ((clock_s[1:] + SWITCHED_ON_S) * 1e9 / resolution_ns).astype(np.int64) * resolution_ns,
        draw_arrivals(end_s + latency_s, arrival_rng),
        end_s,
        duration_s,
        rate,
        force,
        device.temperature_c(end_s),
    )
    samples = apply_conditions(samples, conditions, condition_rng)
    truth = ImuTruth(
        mounting,
        latency_s,
        device.gyro_matrix,
        device.accelerometer_matrix,
        gyro_bias,
        accelerometer_bias,
        environment.gravity_mps2,
        environment.earth_rate_radps,
        device.model.noise,
    )
    return SimulatedImuRun(
        apply_setup_errors(samples, config.setup_error),
        truth,
        configured_parameters(truth, config.setup_error),
    )


def ideal_samples(
    motion_at: MotionAt,
    environment: Environment,
    mountings: Sequence[tuple[float, Mounting]],
    end_s: NDArray[np.float64],
    duration_s: NDArray[np.float64],
) -> InertialSamples:
    """Return what an IMU without errors measures: mean angular rate and specific force over N intervals, in its axes.

    ``mountings``: from which instant on each applies; the first one from the start, a later one after a knock, which takes
    :data:`KNOCK_S`. Four-point Gauss quadrature.
    """
    rate, force = np.empty((len(end_s), 3)), np.empty((len(end_s), 3))
    for first in range(0, len(end_s), _BLOCK):
        rows = slice(first, first + _BLOCK)
        times_s = end_s[rows, None] + (_NODES - 0.5) * duration_s[rows, None]
        found = _instantaneous(motion_at(times_s.ravel()), environment, mountings, times_s.ravel())
        for target, values in zip((rate, force), found, strict=True):
            target[rows] = np.einsum("nki,k->ni", values.reshape(*times_s.shape, 3), _WEIGHTS)
    return InertialSamples(end_s, duration_s, rate, force)


def _instantaneous(
    motion: RigidMotion,
    environment: Environment,
    mountings: Sequence[tuple[float, Mounting]],
    times_s: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angular rate against inertial space and specific force at N instants in the axes of the IMU, (N, 3) each."""
    rate, force = np.empty((len(times_s), 3)), np.empty((len(times_s), 3))
    starts_s = [-np.inf, *(start_s for start_s, _ in mountings[1:]), np.inf]
    previous = mountings[0][1]
    for (from_s, until_s), (_, mounting) in zip(pairwise(starts_s), mountings, strict=True):
        rows = (times_s >= from_s) & (times_s < until_s)
        if rows.any():
            share = np.clip((times_s[rows] - from_s) / KNOCK_S, 0.0, 1.0)
            imu = _moving(_select(motion, rows), previous, mounting, share)
            to_imu = np.swapaxes(imu.rotation, 1, 2)
            coriolis = 2.0 * np.cross(environment.earth_rate_radps, imu.velocity_mps)
            rate[rows] = imu.angular_rate_radps + rotate(to_imu, environment.earth_rate_radps)
            force[rows] = rotate(to_imu, imu.acceleration_mps2 + coriolis - environment.gravity_mps2)
        previous = mounting
    return rate, force


def _select(motion: RigidMotion, rows: NDArray[np.bool_]) -> RigidMotion:
    return replace(motion, **{each.name: getattr(motion, each.name)[rows] for each in fields(motion)})


def _moving(robot: RigidMotion, before: Mounting, after: Mounting, share: NDArray[np.float64]) -> RigidMotion:
    """Motion of the axes of an IMU on its way from one mounting to another; ``share`` (N,) of the time of a knock."""
    # From rest to rest, with the least jerk.
    way = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    speed = 30.0 * share**2 * (1.0 - share) ** 2 / KNOCK_S
    acceleration = 60.0 * share * (1.0 - share) * (1.0 - 2.0 * share) / KNOCK_S**2
    displacement = after.position_m - before.position_m
    turn = log_so3((before.R_robot_imu.T @ after.R_robot_imu)[None])[0]
    return robot.at_point(
        before.position_m + way[:, None] * displacement,
        speed[:, None] * displacement,
        acceleration[:, None] * displacement,
    ).turned(
        before.R_robot_imu @ exp_so3(way[:, None] * turn), speed[:, None] * turn, acceleration[:, None] * turn
    )


def _mountings(mounting: Mounting, knocks: Sequence[Knock]) -> list[tuple[float, Mounting]]:
    found = [(0.0, mounting)]
    for knock in sorted(knocks, key=lambda each: each.at_s):
        found.append((knock.at_s, knock.knocked(found[-1][1])))
    return found


def _measured(
    device: ImuDevice,
    ideal: InertialSamples,
    bias_rng: np.random.Generator,
    noise_rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return angular rate and specific force as measured, and the biases of gyro and accelerometer, (N, 3) each."""
    model, noise = device.model, device.model.noise
    warming_k = device.warming_k(ideal.end_s)[:, None]
    root_s = np.sqrt(ideal.duration_s)[:, None]
    shape = (len(ideal), 3)
    gyro_bias = (
        bias_rng.normal(0.0, noise.gyro_bias_radps, 3)
        + np.cumsum(noise.gyro_bias_walk * root_s * bias_rng.standard_normal(shape), axis=0)
        + device.gyro_bias_per_k * warming_k
    )
    accelerometer_bias = (
        bias_rng.normal(0.0, noise.accelerometer_bias_mps2, 3)
        + np.cumsum(noise.accelerometer_bias_walk * root_s * bias_rng.standard_normal(shape), axis=0)
        + device.accelerometer_bias_per_k * warming_k
    )
    rate = (
        (ideal.angular_rate_radps * (1.0 + device.gyro_scale_per_k * warming_k)) @ device.gyro_matrix.T
        + ideal.specific_force_mps2 @ device.gyro_g_sensitivity.T
        + gyro_bias
        + noise.gyro_noise_density / root_s * noise_rng.standard_normal(shape)
    )
    force = (
        (ideal.specific_force_mps2 * (1.0 + device.accelerometer_scale_per_k * warming_k))
        @ device.accelerometer_matrix.T
        + accelerometer_bias
        + noise.accelerometer_noise_density / root_s * noise_rng.standard_normal(shape)
    )
    return (
        _digitised(rate, model.gyro_resolution_radps, model.gyro_range_radps),
        _digitised(force, model.accelerometer_resolution_mps2, model.accelerometer_range_mps2),
        gyro_bias,
        accelerometer_bias,
    )


def _digitised(values: NDArray[np.float64], resolution: float, limit: float) -> NDArray[np.float64]:
    return np.clip(np.round(values / resolution) * resolution, -limit, limit)
