"""Prediction of the rotation beyond the last sample: against integrals of signals that are known, and its stated error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from tsgt.geometry.inertial import InertialSamples
from tsgt.geometry.inertial.live.rate_prediction import RotationPredictor

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

INTERVAL_S = 0.005
BIAS = np.array([0.01, -0.02, 0.005])


def samples_of(rate: FloatArray) -> InertialSamples:
    """Return samples of angular rates, (N, 3)."""
    count = len(rate)
    end_s = INTERVAL_S * np.arange(1, count + 1, dtype=np.float64)
    return InertialSamples(end_s, np.full(count, INTERVAL_S), rate, np.zeros((count, 3)))


def learnt(samples: InertialSamples, stop: int) -> RotationPredictor:
    """Return a predictor that has taken the first samples in lines of five."""
    found = RotationPredictor()
    for first in range(0, stop, 5):
        found.learn(samples.select(slice(first, first + 5)))
    return found


@pytest.mark.parametrize("duration_s", [0.003, 0.005, 0.0175, 0.06, 0.1])
def test_vibration_of_an_engine_is_predicted(duration_s: float) -> None:
    """Two tones continue; their integral is known."""
    tones = ((2 * np.pi * 17.3, 0.05), (2 * np.pi * 41.0, 0.03))
    end_s = INTERVAL_S * np.arange(1, 4001, dtype=np.float64)

    def angle(time_s: FloatArray) -> FloatArray:
        terms = [a / w * np.sin(w * time_s[:, None] + np.arange(3)) for w, a in tones]
        total: FloatArray = terms[0] + terms[1]
        return total

    rate: FloatArray = (angle(end_s) - angle(end_s - INTERVAL_S)) / INTERVAL_S
    rate += 1e-5 * np.random.default_rng(0).normal(size=rate.shape)
    samples = samples_of(rate + BIAS)
    predictor = learnt(samples, 4000)
    found = predictor.predict(samples, BIAS, duration_s)
    assert found is not None
    expected = angle(end_s[-1:] + duration_s) - angle(end_s[-1:])
    # Between samples the angle is linear.
    curvature = 0.125 * INTERVAL_S**2 * sum(w * a for w, a in tones)
    np.testing.assert_allclose(found.rate * duration_s, expected[0], atol=curvature + 2e-5)


def test_stated_error_is_that_of_random_shaking() -> None:
    """Band-limited noise and slow turns of a robot that drives and stands: errors in sigmas, and less than of a rate that is held."""
    rng = np.random.default_rng(1)
    sos = butter(4, (8.0, 60.0), "band", fs=1 / INTERVAL_S, output="sos")
    count = 12_000
    shaking = sosfilt(sos, rng.normal(size=(count, 3)), axis=0)
    moving = 0.02 + 0.5 * (1 + np.tanh(5 * np.sin(np.arange(count) * INTERVAL_S / 3.0)))
    turn = 0.3 * np.sin(np.arange(count)[:, None] * INTERVAL_S / 4.0 + np.arange(3))
    rate: FloatArray = (0.06 * shaking + turn) * moving[:, None]
    samples = samples_of(rate + BIAS)
    predictor = RotationPredictor()
    errors, sigmas, held = [], [], []
    for stop in range(5, count - 5, 5):
        predictor.learn(samples.select(slice(stop - 5, stop)))
        found = predictor.predict(samples.select(slice(max(stop - 45, 0), stop)), BIAS, 5 * INTERVAL_S)
        if found is None:
            continue
        angle = rate[stop : stop + 5].sum(axis=0) * INTERVAL_S
        errors.append(angle - found.rate * 5 * INTERVAL_S)
        held.append(angle - rate[stop - 20 : stop].mean(axis=0) * 5 * INTERVAL_S)
        sigmas.append(found.sigma_rad)
    normalised = np.array(errors) / np.array(sigmas)[:, None]
    assert 0.7 < np.sqrt((normalised**2).mean()) < 1.4
    assert np.sqrt(np.mean(np.square(errors))) < 0.9 * np.sqrt(np.mean(np.square(held)))


def test_too_little_learnt_or_a_gap() -> None:
    """No prediction is made."""
    rate = np.random.default_rng(2).normal(size=(4000, 3))
    samples = samples_of(rate)
    assert learnt(samples, 1500).predict(samples.select(slice(1500)), BIAS, 0.02) is None
    predictor = learnt(samples, 4000)
    assert predictor.predict(samples, BIAS, 0.02) is not None
    gap = samples.select(np.delete(np.arange(4000), 3990))
    assert predictor.predict(gap, BIAS, 0.02) is None
    assert predictor.predict(samples.select(slice(30)), BIAS, 0.02) is None


@pytest.mark.parametrize("counts", [(0, 0, 0), (-3, -2, 0), (1, -2, 2), (-3, 1, 1)])
def test_gyro_whose_values_never_change(counts: tuple[int, int, int]) -> None:
    """Failed to 0, or dead-banded on a standing robot: nothing is learnt, whatever rounding leaves of the mean."""
    constant = np.radians(np.array(counts) / 16.4)
    samples = samples_of(np.tile(constant, (4000, 1)))
    assert learnt(samples, 4000).predict(samples, BIAS, 0.02) is None


def test_gyro_whose_values_stop_changing() -> None:
    """What was learnt before stays, and the angle predicted is that of the constant rate."""
    rate = np.random.default_rng(2).normal(size=(8000, 3))
    rate[4000:] = np.radians([1.0, 2.0, 3.0])
    samples = samples_of(rate)
    found = learnt(samples, 8000).predict(samples, BIAS, 0.02)
    assert found is not None
    assert np.isfinite(found.sigma_rad)
    np.testing.assert_allclose(found.rate, rate[-1] - BIAS, atol=1e-12)
