"""Preintegration: against integration at fine steps, an analytic motion, Monte Carlo, differences and composition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.geometry import FloatArray, exp_so3, log_so3
from tsgt.geometry.inertial import (
    ContiguousSamples,
    InertialSamples,
    Preintegrated,
    contiguous,
    preintegrate,
)
from tsgt.geometry.inertial.preintegration import (
    GAP_ANGULAR_RATE_SIGMA_RADPS,
    GAP_SPECIFIC_FORCE_SIGMA_MPS2,
    preintegrate_with_matrices,
)
from tsgt.model import ImuNoise

NOISE = ImuNoise(
    gyro_noise_density=3e-3,
    accelerometer_noise_density=2e-2,
    gyro_bias_walk=1e-5,
    accelerometer_bias_walk=1e-4,
    gyro_bias_radps=3e-3,
    accelerometer_bias_mps2=3e-2,
)
STEP_S = 0.005
NO_BIAS = np.zeros(3)


def shaken(count: int = 60, seed: int = 0) -> InertialSamples:
    """Simulate samples of a violent motion from 10 s on."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(count, dtype=np.float64)[:, None] * STEP_S
    rate = np.array([0.5, -0.8, 2.0]) + np.sin(time_s * [30, 40, 50]) + rng.normal(scale=0.1, size=(count, 3))
    force = (
        np.array([1.0, 2.0, 9.8]) + 3 * np.cos(time_s * [40, 20, 30]) + rng.normal(scale=0.5, size=(count, 3))
    )
    return InertialSamples(10.0 + STEP_S + time_s[:, 0], np.full(count, STEP_S), rate, force)


def over(
    samples: ContiguousSamples, *times_s: float, gyro: FloatArray = NO_BIAS, force: FloatArray = NO_BIAS
) -> Preintegrated:
    """Preintegrate between neighbouring times."""
    return preintegrate(samples, np.array(times_s[:-1]), np.array(times_s[1:]), gyro, force)


def error(result: Preintegrated, reference: Preintegrated) -> FloatArray:
    """(K, 9) error of preintegrated motions about others."""
    turned = np.swapaxes(reference.rotation, 1, 2) @ result.rotation
    return np.concatenate(
        [
            result.position - reference.position,
            log_so3(turned),
            result.velocity - reference.velocity,
        ],
        axis=1,
    )


@pytest.mark.parametrize(("start_s", "end_s"), [(10.0, 10.135), (10.0021, 10.1987), (10.011, 10.0123)])
def test_equals_integration_at_fine_steps(start_s: float, end_s: float) -> None:
    """An interval cut anywhere has the motion of a hundred steps per sample at constant rate and force."""
    samples = contiguous(shaken(), NOISE)
    inside = samples.bounds_s[(samples.bounds_s > start_s) & (samples.bounds_s < end_s)]
    cuts_s = np.concatenate([[start_s], inside, [end_s]])
    steps_s = np.repeat(np.diff(cuts_s) / 100, 100)
    index = np.repeat(np.searchsorted(samples.bounds_s, 0.5 * (cuts_s[1:] + cuts_s[:-1])) - 1, 100)
    rotation, velocity, position = Rotation.identity(), np.zeros(3), np.zeros(3)
    gyro, bias = np.array([0.01, -0.02, 0.03]), np.array([0.1, -0.2, 0.05])
    for i, dt_s in zip(index, steps_s, strict=True):
        rate, force = samples.angular_rate_radps[i] - gyro, samples.specific_force_mps2[i] - bias
        increment = (rotation * Rotation.from_rotvec(0.5 * dt_s * rate)).apply(force) * dt_s
        position += velocity * dt_s + 0.5 * dt_s * increment
        velocity += increment
        rotation *= Rotation.from_rotvec(dt_s * rate)
    found = over(samples, start_s, end_s, gyro=gyro, force=bias)
    np.testing.assert_allclose(found.duration_s, end_s - start_s)
    np.testing.assert_allclose(found.rotation[0], rotation.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found.velocity[0], velocity, atol=1e-8)
    np.testing.assert_allclose(found.position[0], position, atol=3e-8)


def test_analytic_motion() -> None:
    """Mean rates and forces of a known motion give its displacement, less gravity's, to micrometres."""

    def pose(t: FloatArray) -> tuple[FloatArray, FloatArray]:
        turn = np.stack([0.1 * np.sin(3 * t), 0.15 * np.cos(2 * t), 0.8 * t], axis=-1)
        place = np.stack([2 * np.sin(0.7 * t), 1.5 * np.cos(0.9 * t), 0.05 * np.sin(4 * t)], axis=-1)
        return exp_so3(turn), place

    h = 1e-4
    fine_s = np.arange(0.0, 0.2 + 1.5 * h, h)
    R = pose(fine_s)[0]
    middle, before, after = (
        pose(fine_s[:-1] + h / 2),
        pose(fine_s[:-1] - h / 2),
        pose(fine_s[:-1] + 3 * h / 2),
    )
    gravity = np.array([0.0, 0.0, -9.81])
    rate = log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / h
    force = np.einsum("nji,nj->ni", middle[0], (before[1] - 2 * middle[1] + after[1]) / h**2 - gravity)
    rate, force = (values[:2000].reshape(40, 50, 3).mean(axis=1) for values in (rate, force))
    samples = InertialSamples(np.arange(1, 41, dtype=np.float64) * STEP_S, np.full(40, STEP_S), rate, force)
    found = over(contiguous(samples, NOISE), 0.0, 0.2)
    velocity = (pose(np.array([h, 0.2 + h]))[1] - pose(np.array([-h, 0.2 - h]))[1]) / (2 * h)
    (R0, R1), (p0, p1) = pose(np.array([0.0, 0.2]))
    np.testing.assert_allclose(found.rotation[0], R0.T @ R1, atol=1e-6)
    np.testing.assert_allclose(
        found.velocity[0], R0.T @ (velocity[1] - velocity[0] - 0.2 * gravity), atol=2e-5
    )
    np.testing.assert_allclose(
        found.position[0], R0.T @ (p1 - p0 - 0.2 * velocity[0] - 0.02 * gravity), atol=5e-6
    )


def test_covariance_equals_monte_carlo() -> None:
    """The covariance is that of white noise on the samples."""
    count, draws = 27, 8_000
    rng = np.random.default_rng(1)
    samples = contiguous(shaken(count), NOISE)
    exact = over(samples, 10.0, 10.0 + count * STEP_S)
    size = (draws, count, 3)
    noisy = replace(
        samples,
        bounds_s=np.arange(draws * count + 1, dtype=np.float64) * STEP_S,
        angular_rate_radps=(
            samples.angular_rate_radps
            + rng.normal(scale=NOISE.gyro_noise_density / np.sqrt(STEP_S), size=size)
        ).reshape(-1, 3),
        specific_force_mps2=(
            samples.specific_force_mps2
            + rng.normal(scale=NOISE.accelerometer_noise_density / np.sqrt(STEP_S), size=size)
        ).reshape(-1, 3),
        gyro_density=np.tile(samples.gyro_density, draws),
        accelerometer_density=np.tile(samples.accelerometer_density, draws),
        missing=np.tile(samples.missing, draws),
    )
    drawn = over(noisy, *(np.arange(draws + 1) * count * STEP_S))
    errors = error(drawn, exact.select(np.zeros(draws, np.intp)))
    root = np.linalg.cholesky(exact.covariance[0])
    whitened = np.linalg.solve(root, errors.T)
    # Sampling error of a covariance of unit variance: 1 / sqrt(draws) = 0.011.
    np.testing.assert_allclose(whitened @ whitened.T / draws, np.eye(9), atol=0.06)
    np.testing.assert_allclose(exact.covariance, np.swapaxes(exact.covariance, 1, 2), rtol=0, atol=1e-18)


@pytest.mark.parametrize("sensor", ["gyro", "force"])
def test_jacobians_by_biases_equal_differences(sensor: str) -> None:
    """Central differences by each component of a bias, of an interval that cuts samples."""
    samples = contiguous(shaken(), NOISE)
    start = over(samples, 10.0013, 10.1372)
    jacobian = start.by_gyro_bias if sensor == "gyro" else start.by_accelerometer_bias
    h = 1e-4
    numerical = np.empty((9, 3))
    for axis in range(3):
        bias = h * np.eye(3)[axis]
        plus, minus = (over(samples, 10.0013, 10.1372, **{sensor: sign * bias}) for sign in (1, -1))
        numerical[:, axis] = (error(plus, start) - error(minus, start))[0] / (2 * h)
    np.testing.assert_allclose(jacobian[0], numerical, atol=1e-5)


def test_first_order_correction() -> None:
    """Correcting for a bias costs errors of second order only."""
    samples = contiguous(shaken(), NOISE)
    gyro, force = np.array([2e-3, -1e-3, 3e-3]), np.array([0.02, -0.03, 0.01])
    found = over(samples, 10.0, 10.2)
    again = over(samples, 10.0, 10.2, gyro=gyro, force=force)
    position, rotation, velocity = found.corrected(gyro[None], force[None])
    corrected = replace(found, position=position, rotation=rotation, velocity=velocity)
    assert np.abs(error(found, again)).max() > 4e-4
    assert np.abs(error(corrected, again)).max() < 2e-6


def test_composed_parts_equal_the_whole() -> None:
    """Motion, covariance and Jacobians of an interval are those of its two parts, composed."""
    samples = contiguous(shaken(), NOISE)
    whole, parts = over(samples, 10.0012, 10.2033), over(samples, 10.0012, 10.0831, 10.2033)
    (R1, R2), (v1, v2), (p1, p2) = parts.rotation, parts.velocity, parts.position
    T2 = parts.duration_s[1]
    composed = replace(
        whole,
        rotation=(R1 @ R2)[None],
        velocity=(v1 + R1 @ v2)[None],
        position=(p1 + v1 * T2 + R1 @ p2)[None],
    )
    np.testing.assert_allclose(error(composed, whole), 0, atol=1e-12)
    by_first, by_second = np.eye(9), np.eye(9)
    skew_T = np.cross(v2, np.eye(3)), np.cross(p2, np.eye(3))
    by_first[3:6, 3:6] = R2.T
    by_first[0:3, 6:9] = T2 * np.eye(3)
    by_first[6:9, 3:6], by_first[0:3, 3:6] = R1 @ skew_T[0], R1 @ skew_T[1]
    by_second[0:3, 0:3] = by_second[6:9, 6:9] = R1
    covariance = by_first @ parts.covariance[0] @ by_first.T + by_second @ parts.covariance[1] @ by_second.T
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(whole.covariance[0] / scale, covariance / scale, atol=2e-3)
    for name in ("by_gyro_bias", "by_accelerometer_bias"):
        first, second = getattr(parts, name)
        np.testing.assert_allclose(getattr(whole, name)[0], by_first @ first + by_second @ second, atol=1e-6)


def test_interval_alone_equals_itself_in_a_batch() -> None:
    """Intervals of different length are padded to one length."""
    samples = contiguous(shaken(600), NOISE)
    times_s = 10.0 + np.cumsum(np.concatenate([[0.0], np.random.default_rng(2).uniform(0.001, 0.2, 28)]))
    batch = over(samples, *times_s)
    for row in (0, 7, 27):
        alone = over(samples, times_s[row], times_s[row + 1])
        for name in Preintegrated.__slots__:
            np.testing.assert_allclose(
                getattr(alone, name)[0], getattr(batch, name)[row], rtol=1e-11, atol=1e-15
            )


def test_missing_samples_are_bridged_with_the_uncertainty_of_the_motion() -> None:
    """A gap is filled by the mean of its neighbours; its length and its uncertainty are known."""
    samples = shaken(60)
    keep = np.ones(60, np.bool_)
    keep[20:30] = False
    filled = contiguous(samples.select(keep), NOISE)
    assert np.diff(filled.bounds_s)[20] == pytest.approx(0.05)
    np.testing.assert_allclose(
        filled.angular_rate_radps[20], 0.5 * (samples.angular_rate_radps[19] + samples.angular_rate_radps[30])
    )
    found = over(filled, 10.0, 10.1, 10.2, 10.3)
    np.testing.assert_allclose(found.missing_s, [0.0, 0.05, 0.0], atol=1e-12)
    sigmas = np.sqrt(np.einsum("kii->ki", found.covariance))
    assert sigmas[1, 3] == pytest.approx(GAP_ANGULAR_RATE_SIGMA_RADPS * 0.05, rel=1e-2)
    assert sigmas[1, 6] == pytest.approx(GAP_SPECIFIC_FORCE_SIGMA_MPS2 * 0.05, rel=0.1)
    assert sigmas[1, 3] > 20 * sigmas[0, 3]


def test_time_beyond_the_samples_is_a_gap() -> None:
    """Before the first and after the last sample the motion is as uncertain as in a gap."""
    filled = contiguous(shaken(20), NOISE, start_s=9.9, end_s=10.3)
    found = over(filled, 9.9, 10.05, 10.3)
    np.testing.assert_allclose(found.missing_s, [0.1, 0.2], atol=1e-9)


def test_jitter_of_the_stamps_keeps_the_increments() -> None:
    """Stamps that jitter by a millisecond neither add nor lose rotation: the device's durations count."""
    samples = shaken(60)
    jitter_s = np.random.default_rng(4).uniform(-1e-3, 1e-3, 60)
    jitter_s[[19, 59]] = 0.0
    late = replace(samples, end_s=samples.end_s + jitter_s)
    exact, found = over(contiguous(samples, NOISE), 10.1, 10.3), over(contiguous(late, NOISE), 10.1, 10.3)
    np.testing.assert_allclose(found.rotation, exact.rotation, atol=1e-12)
    np.testing.assert_allclose(found.velocity, exact.velocity, atol=1e-12)


def test_rate_and_force_at_instants() -> None:
    """Linear between the middles of the samples, constant beyond them."""
    samples = shaken(10)
    rate, force = contiguous(samples, NOISE).at(np.array([9.0, 10.0025, 10.005, 20.0]))
    np.testing.assert_allclose(rate[[0, 1, 3]], samples.angular_rate_radps[[0, 0, 9]])
    np.testing.assert_allclose(force[2], samples.specific_force_mps2[:2].mean(axis=0))


def test_jacobians_by_matrices_equal_differences() -> None:
    """Rates or forces that are all multiplied by a matrix change the motion as the Jacobians say."""
    samples = contiguous(shaken(), NOISE)
    edges_s = np.array([10.0021, 10.1, 10.21])
    gyro, bias = np.array([0.01, -0.02, 0.03]), np.array([0.1, -0.2, 0.05])
    jacobians = preintegrate_with_matrices(samples, edges_s[:-1], edges_s[1:], gyro, bias)[1:]
    step = 1e-5
    for name, jacobian in zip(("angular_rate_radps", "specific_force_mps2"), jacobians, strict=True):
        for row, column in np.ndindex(3, 3):
            matrix = np.zeros((3, 3))
            matrix[row, column] = step
            after, before = (
                over(
                    replace(samples, **{name: getattr(samples, name) @ (np.eye(3) + sign * matrix).T}),
                    *edges_s,
                    gyro=gyro,
                    force=bias,
                )
                for sign in (1, -1)
            )
            expected = error(after, before) / (2 * step)
            np.testing.assert_allclose(jacobian[:, :, row, column], expected, atol=2e-3)
