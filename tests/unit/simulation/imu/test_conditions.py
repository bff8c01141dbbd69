"""Faults of the IMU: each changes what it says, from its start to its end, and nothing else."""

from __future__ import annotations

from dataclasses import fields
from functools import cache

import numpy as np
import pytest

from tsgt.config import ImuSetupErrorConfig, SimulatedImu
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.simulation.imu import (
    DeviceClockJump,
    DeviceSamples,
    Dropout,
    ImuCondition,
    Knock,
    LateBurst,
    Saturation,
    Silence,
    SimulatedImuRun,
    StuckValues,
    mounting_of,
    simulate_imu,
)
from tsgt.simulation.rigid_motion import RigidMotion

CONFIG = SimulatedImu(model="industrial")
UNTIL_S = 6.0


def _turntable(times_s: np.ndarray) -> RigidMotion:
    zero = np.zeros((len(times_s), 3))
    yaw = 2.0 * times_s
    rotation = np.zeros((len(times_s), 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(yaw)
    rotation[:, 1, 0] = np.sin(yaw)
    rotation[:, 0, 1] = -np.sin(yaw)
    rotation[:, 2, 2] = 1.0
    return RigidMotion(rotation, zero, zero, zero, zero + np.array([0.0, 0.0, 2.0]), zero)


@cache
def _run(*conditions: ImuCondition, setup_error: str = "") -> SimulatedImuRun:
    error = ImuSetupErrorConfig(**{setup_error: True}) if setup_error else ImuSetupErrorConfig()
    config = CONFIG.model_copy(update={"setup_error": error})
    return simulate_imu(config, _turntable, UNTIL_S, seed=[3], conditions=conditions)


def _changed(samples: DeviceSamples) -> set[str]:
    """Return the arrays that differ from those without faults, for the same samples."""
    sound = _run().samples
    sound = sound.select(np.isin(sound.counter, samples.counter))
    return {
        each.name
        for each in fields(samples)
        if not np.array_equal(getattr(samples, each.name), getattr(sound, each.name))
    }


def test_dropout_loses_counted_samples() -> None:
    """Half the samples of two seconds are missing; those left are unchanged."""
    samples = _run(Dropout(2.0, 2.0, 0.5)).samples
    assert _changed(samples) == set()
    lost = np.setdiff1d(_run().samples.counter, samples.counter)
    assert 160 < len(lost) < 240
    lost_s = _run().samples.end_s[lost]
    assert lost_s.min() >= 2.0
    assert lost_s.max() < 4.0


def test_silence_loses_all_samples() -> None:
    """There is one gap, as long as the silence."""
    samples = _run(Silence(2.0, 2.0)).samples
    assert _changed(samples) == set()
    assert np.diff(samples.end_s).max() == pytest.approx(2.0, abs=0.006)
    assert np.diff(samples.counter).max() == 401


def test_stuck_values_repeat_the_last_ones() -> None:
    """Counter and clock run on."""
    samples = _run(StuckValues(2.0, 1.0)).samples
    assert _changed(samples) == {"angular_rate_radps", "specific_force_mps2"}
    rows = (samples.end_s >= 2.0) & (samples.end_s < 3.0)
    assert len(np.unique(samples.angular_rate_radps[rows], axis=0)) == 1
    assert len(np.unique(samples.angular_rate_radps[~rows], axis=0)) > 900


def test_clock_jump_stays() -> None:
    """Only the device's clock jumps, by the given time, and stays."""
    samples = _run(DeviceClockJump(2.0, -0.5)).samples
    assert _changed(samples) == {"device_ns"}
    change_ns = samples.device_ns - _run().samples.device_ns
    np.testing.assert_array_equal(change_ns, np.where(samples.end_s >= 2.0, -500_000_000, 0))


def test_clock_begins_at_zero() -> None:
    """Jumps back, however many, lead to the start of the clock at most, as a restart of the device does."""
    samples = _run(DeviceClockJump(2.0, -100.0), DeviceClockJump(4.0, -100.0)).samples
    assert samples.device_ns[samples.end_s >= 4.0][0] == 0
    assert samples.device_ns.min() == 0


def test_late_burst_arrives_at_its_end() -> None:
    """What arrives in the interval arrives at its end, in order."""
    samples = _run(LateBurst(2.0, 0.7)).samples
    assert _changed(samples) == {"arrival_s"}
    assert not np.any((samples.arrival_s >= 2.0) & (samples.arrival_s < 2.7))
    assert 135 < np.sum(samples.arrival_s == 2.7) < 145
    assert np.diff(samples.arrival_s).min() >= 0


def test_saturation_clips() -> None:
    """Values stop at the limits within the interval."""
    samples = _run(Saturation(2.0, 1.0, 1.0, 5.0)).samples
    assert _changed(samples) == {"angular_rate_radps", "specific_force_mps2"}
    rows = (samples.end_s >= 2.0) & (samples.end_s < 3.0)
    assert np.abs(samples.angular_rate_radps[rows]).max() == 1.0
    assert np.abs(samples.specific_force_mps2[rows]).max() == 5.0
    assert np.abs(samples.angular_rate_radps[~rows]).max() > 1.9


def test_knock_turns_the_axes_and_moves_the_origin() -> None:
    """Afterwards rates and forces are those of the new mounting, which the truth at the start does not have."""
    knock = Knock(2.0, (0.0, 0.1, 0.0), (0.02, 0.0, 0.0))
    sound, knocked = _run(), _run(knock)
    before = knocked.samples.end_s < 2.0
    np.testing.assert_array_equal(
        knocked.samples.angular_rate_radps[before], sound.samples.angular_rate_radps[before]
    )
    new = knock.knocked(mounting_of(CONFIG))
    turned = log_so3((mounting_of(CONFIG).R_robot_imu.T @ new.R_robot_imu)[None])[0]
    np.testing.assert_allclose(turned, knock.rotation_rad, atol=1e-12)
    after = knocked.samples.end_s > 2.1
    change = knocked.samples.specific_force_mps2[after].mean(axis=0) - sound.samples.specific_force_mps2[
        after
    ].mean(axis=0)
    centripetal = np.array([-4.0 * 0.02, 0.0, 0.0])
    up = np.array([0.0, 0.0, 9.80752])
    old = np.array([-4.0 * 0.21, 4.0 * 0.12, 0.0])
    expected = new.R_robot_imu.T @ (up + old + centripetal) - mounting_of(CONFIG).R_robot_imu.T @ (up + old)
    np.testing.assert_allclose(change, expected, atol=3e-3)


def test_knock_is_part_of_the_motion() -> None:
    """The gyro measures the turn, the accelerometer a shock that moves the origin from rest to rest."""
    knock = Knock(2.0, (0.0, 0.02, 0.0), (0.003, 0.0, 0.0))
    sound, knocked = _run().samples, _run(knock).samples
    during = (sound.end_s > 2.0) & (sound.end_s < 2.03)
    rate, force = (
        (getattr(knocked, name) - getattr(sound, name))[during]
        for name in ("angular_rate_radps", "specific_force_mps2")
    )
    period_s = sound.duration_s[during][:, None]
    # Of the turntable's rotation and of gravity in the new axes there is little in 30 ms.
    np.testing.assert_allclose((rate * period_s).sum(axis=0), knock.rotation_rad, atol=1e-3)
    robot = force @ mounting_of(CONFIG).R_robot_imu.T
    assert robot[:, 0].max() > 20.0
    velocity = np.cumsum(robot * period_s, axis=0)[:, 0]
    assert abs(velocity[-1]) < 0.01
    assert (velocity * period_s[:, 0]).sum() == pytest.approx(0.003, abs=2e-4)


@pytest.mark.parametrize("name", ["axes_swapped", "degrees", "gravity_inverted"])
def test_setup_errors_of_the_program(name: str) -> None:
    """Axes are exchanged, rates are in degrees, the force has the wrong sign; nothing else changes."""
    sound, wrong = _run().samples, _run(setup_error=name).samples
    rate, force = sound.angular_rate_radps, sound.specific_force_mps2
    if name == "axes_swapped":
        rate, force = (np.stack([v[:, 1], v[:, 0], -v[:, 2]], axis=1) for v in (rate, force))
    elif name == "degrees":
        rate = rate * 180.0 / np.pi
    else:
        force = -force
    np.testing.assert_allclose(wrong.angular_rate_radps, rate)
    np.testing.assert_allclose(wrong.specific_force_mps2, force)


def test_setup_errors_of_the_configuration() -> None:
    """Mounting, position and latency are off by the given amounts; the samples are sound."""
    error = ImuSetupErrorConfig(rotation_deg=1.0, position_mm=100.0, latency_ms=10.0)
    config = CONFIG.model_copy(update={"setup_error": error})
    run = simulate_imu(config, _turntable, UNTIL_S, seed=[3])
    assert _changed(run.samples) == set()
    configured, exact = run.parameters, _run().parameters
    turn = rotation_from_quaternion(np.array(exact.orientation_xyzw)).T @ rotation_from_quaternion(
        np.array(configured.orientation_xyzw)
    )
    assert np.degrees(np.linalg.norm(log_so3(turn[None]))) == pytest.approx(1.0)
    np.testing.assert_allclose(
        np.subtract(configured.position_m, exact.position_m), [0.1, 0.0, 0.0], atol=1e-12
    )
    assert configured.latency_ns - exact.latency_ns == 10_000_000
