"""Stated covariances where the truth is drawn from the estimator's own model: NEES in its band, post-processed and live."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial import inertial_drive as harness
from harness.inertial.inertial_drive import imu_parameters, inertial_drive

from tsgt.geometry import log_so3
from tsgt.geometry.inertial import (
    Gravity,
    InertialFixedLagSmoother,
    Mounting,
    estimation_noise,
    fit_inertial_trajectory,
    smoother,
)
from tsgt.geometry.inertial.live import fixed_lag
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialSamples
    from tsgt.geometry.trajectory import Observations, States
    from tsgt.model import ImuNoise

DURATION_S = 30.0
SEEDS = 16
BAND = (4.8, 7.2)
"""Of the mean NEES of 6 components over 16 drives, whose poses are correlated over some ten seconds: 6 +- 4 sigma."""
DRIVE = inertial_drive(DURATION_S, seed=12)
CENTROID = DRIVE.layout.mean(axis=0)
# Vertical z axis, as in the harness; what the estimator adds to a data sheet is drawn as well.
IMU = replace(imu_parameters(), noise=estimation_noise(imu_parameters().noise), tilt_sigma_rad=1e-6)


@pytest.fixture(autouse=True)
def own_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assume the noise that is drawn, on an Earth that stands still."""

    def as_drawn(noise: ImuNoise) -> ImuNoise:
        return noise

    monkeypatch.setattr(harness, "EARTH_RATE_RADPS", 0.0)
    monkeypatch.setattr(smoother, "estimation_noise", as_drawn)
    monkeypatch.setattr(fixed_lag, "estimation_noise", as_drawn)


def measured(stations: int, seed: int) -> Observations:
    """Measure with the noise that is stated."""
    found = DRIVE.measure(stations=stations, seed=seed)
    # The harness shifts its instants by 0.3 ms, one sigma.
    return replace(found, layout=found.layout - CENTROID, time_sigma_s=np.full(len(found), 3e-4))


def sampled(seed: int) -> InertialSamples:
    """Draw samples, with an error of the accelerometer's axes as it is assumed."""
    samples = DRIVE.samples(IMU, seed=seed)
    vertical = Mounting.of(IMU, CENTROID).rotation[2]
    prior = Gravity.of(IMU).with_matrix(IMU.noise.accelerometer_scale_misalignment, vertical)
    drawn = prior.retract(np.random.default_rng([seed, 1]).normal(scale=prior.prior_sigmas()))
    force = samples.specific_force_mps2
    return replace(samples, specific_force_mps2=force + drawn.force_error(force))


def nees(states: States, covariance: FloatArray) -> FloatArray:
    """Normalised squares of the errors of N poses, (N,)."""
    position, rotation = DRIVE.pose_at(states.time_s)
    turned = log_so3(np.swapaxes(rotation, 1, 2) @ states.rotation)
    errors = np.concatenate([states.position - position - rotation @ CENTROID, turned], axis=1)
    found: FloatArray = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariance), errors)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("stations", [3, 2, 1])
def test_post_processed(stations: int) -> None:
    """Poses twice a second of many drives."""
    found = []
    for seed in range(SEEDS):
        observations, samples = measured(stations, seed), sampled(seed)
        fit = fit_inertial_trajectory(observations, samples, IMU, reference_m=CENTROID)
        found.append(nees(*fit.trajectory.at(np.arange(2.0, DURATION_S - 2.0, 0.5))))
    assert BAND[0] < np.mean(found) < BAND[1]


@pytest.mark.slow
def test_live() -> None:
    """Poses with two stations at the newest sample, 0.35 s after the newest measurement."""
    found = []
    for seed in range(SEEDS // 4):
        observations, samples = measured(2, seed), sampled(seed)
        window = InertialFixedLagSmoother(IMU, MotionPrior(), reference_m=CENTROID)
        taken = added = 0
        for now_s in np.arange(1.0, DURATION_S - 1.0, 0.5):
            stop = int(np.searchsorted(samples.end_s, now_s + 1e-6))
            window.add_samples(samples.select(slice(added, stop)))
            until = int(np.searchsorted(observations.time_s, now_s - 0.35))
            for row in range(taken, until):
                window.update(observations.select(slice(row, row + 1)))
            taken, added = until, stop
            window.marginalise_before(now_s - 3.0)
            if window.converged and now_s > 10.0:
                found.append(nees(*window.predict(now_s))[0])
    assert len(found) > 30 * SEEDS // 4
    assert BAND[0] < np.mean(found) < BAND[1]
