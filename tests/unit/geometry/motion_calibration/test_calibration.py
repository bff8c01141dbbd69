"""Calibration from motion: against a synthetic drive with a known set-up."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.drive import LAYOUT, MOTION_PRIOR, drive, frames

from tsgt.errors import GeometryError
from tsgt.geometry import exp_so3
from tsgt.geometry.motion_calibration import (
    Setup,
    SetupPrior,
    calibrate_motion,
    frames_from_motion,
    unobservable_directions,
)
from tsgt.geometry.motion_calibration.setup_parameters import SetupParameters
from tsgt.geometry.trajectory import Observations, initial_guess, knot_times, linearise

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import MotionCalibration

REFINE = SetupPrior(translation_sigma_m=0.05, rotation_sigma_rad=0.005, latency_sigma_s=0.1)
FROM_NOTHING = SetupPrior(translation_sigma_m=10.0, rotation_sigma_rad=0.2, latency_sigma_s=1.0)


def with_errors(observations: Observations) -> Observations:
    """Station 2 displaced by 5 mm, rotated by 0.5 mrad and stamped 30 ms late."""
    moved = observations.frames.copy()
    moved[1, :3, :3] = exp_so3(np.array([3e-4, -1e-4, 4e-4])) @ moved[1, :3, :3]
    moved[1, :3, 3] += [0.003, -0.002, 0.0035]
    time_s = observations.time_s + 0.03 * (observations.station == 1)
    return replace(observations, frames=moved, time_s=time_s).select(np.argsort(time_s, kind="stable"))


def with_wander(observations: Observations, *, sigma_s: float, piece_s: float, seed: int) -> Observations:
    """Add a random latency of each station in each segment of a drive."""
    late_s = np.random.default_rng(seed).normal(0.0, sigma_s, (3, 100))
    time_s = observations.time_s + late_s[observations.station, (observations.time_s // piece_s).astype(int)]
    return replace(observations, time_s=time_s).select(np.argsort(time_s, kind="stable"))


TRUE = Setup(frames(), np.array([0.0, 0.03, 0.0]), np.zeros((3, 4)), LAYOUT)


def normalised_error(found: MotionCalibration) -> tuple[float, int]:
    """NEES of a result and its degrees of freedom."""
    free = found.prior_sigmas > 0
    error = found.parameters.local_coordinates(found.setup) - found.parameters.local_coordinates(TRUE)
    assert error[~free] == pytest.approx(0.0, abs=1e-12)
    return float(error[free] @ np.linalg.solve(found.covariance[np.ix_(free, free)], error[free])), int(
        free.sum()
    )


def calibration_error(
    found_from: Observations, known: SetupPrior, start: Setup | None = None
) -> tuple[float, int, FloatArray]:
    """NEES of a result, its degrees of freedom, and the error at the robot in m."""
    found = calibrate_motion(found_from, known, start=start, prior=MOTION_PRIOR, noise_scale=1.0)
    missed, _ = found.setup.corrections(TRUE, found.parameters.pivot)
    return *normalised_error(found), missed


@pytest.mark.slow
def test_frame_and_latency_errors_are_recovered() -> None:
    """5 mm, 0.5 mrad and 30 ms are found to 1 mm at the robot; chi squared is in its 99.9 % band."""
    distance, unknowns, missed_m = calibration_error(with_errors(drive()), REFINE)
    assert unknowns == 14
    assert distance < 36.1
    assert np.linalg.norm(missed_m, axis=1).max() < 1e-3


@pytest.mark.slow
def test_latency_sigmas_contain_the_truncation_of_times() -> None:
    """Times of station 2 are earlier by most of a millisecond throughout, those of station 3 later."""
    observations = drive()
    late_s = np.array([0.0, -8e-4, 2e-4])[observations.station]
    shifted = replace(observations, time_s=observations.time_s + late_s)
    order = np.argsort(shifted.time_s, kind="stable")
    start = replace(TRUE, latencies_s=np.zeros(3))
    found = calibrate_motion(shifted.select(order), REFINE, start=start, prior=MOTION_PRIOR, noise_scale=1.0)
    error = found.parameters.local_coordinates(found.setup) - found.parameters.local_coordinates(start)
    variances = np.diag(found.covariance)[found.parameters.latencies]
    assert np.abs(error[found.parameters.latencies]).max() > 4e-4
    assert (np.abs(error[found.parameters.latencies]) < 2.5 * np.sqrt(variances)).all()


@pytest.mark.slow
def test_covariance_is_consistent() -> None:
    """Over eight drives the mean of chi squared stays in its 99 % band."""
    distances = [calibration_error(with_errors(drive(60.0, seed=seed)), REFINE)[0] for seed in range(8)]
    assert 9.6 < np.mean(distances) < 19.3


@pytest.mark.slow
def test_wander_is_estimated_and_included() -> None:
    """Timestamps that wander by 3 ms every 40 s are found, and chi squared stays in its 99 % band."""
    distances, wander_s = [], []
    for seed in range(2):
        observations = with_wander(
            with_errors(drive(160.0, seed=seed)), sigma_s=3e-3, piece_s=40.0, seed=seed
        )
        found = calibrate_motion(observations, REFINE, prior=MOTION_PRIOR, noise_scale=1.0)
        distances.append(normalised_error(found)[0])
        wander_s.append(found.wander_s)
    assert 1.5e-3 < np.mean(wander_s) < 5e-3
    assert 6.2 < np.mean(distances) < 25.5


@pytest.mark.slow
def test_no_wander_in_white_noise() -> None:
    """Less than half a millisecond is found in white noise."""
    assert calibrate_motion(drive(), REFINE, prior=MOTION_PRIOR, noise_scale=1.0).wander_s < 5e-4


def test_gap_of_all_stations() -> None:
    """Half a minute without measurements splits the segments; both sides agree."""
    observations = with_errors(drive())
    observations_with_gap = observations.select((observations.time_s < 20.0) | (observations.time_s > 52.0))
    found = calibrate_motion(observations_with_gap, REFINE, prior=MOTION_PRIOR, noise_scale=1.0)
    assert found.measurements == len(observations_with_gap)
    assert found.outliers < 5
    assert found.birge_ratio < 1.5


@pytest.mark.slow
def test_levelled_stations_have_four_degrees_of_freedom() -> None:
    """Tilts are unchanged, and the result is as certain or better."""
    observations = drive()
    free = calibrate_motion(observations, REFINE, prior=MOTION_PRIOR, noise_scale=1.0)
    level = calibrate_motion(
        observations, replace(REFINE, levelled=True), prior=MOTION_PRIOR, noise_scale=1.0
    )
    assert np.count_nonzero(level.prior_sigmas) == 10
    assert np.allclose(level.setup.frames[:, 2, :3], [0.0, 0.0, 1.0], atol=1e-12)
    at = np.concatenate([level.parameters.translations.ravel(), level.parameters.rotations[:, -1]])
    assert np.all(np.diag(level.covariance)[at] < 1.05 * np.diag(free.covariance)[at])


@pytest.mark.slow
def test_frames_without_initial_frames() -> None:
    """Initial frames are good to decimetres, final ones within their covariance."""
    observations = with_errors(drive())
    observations = replace(observations, frames=np.tile(np.eye(4), (3, 1, 1)))
    rough = frames_from_motion(observations)
    assert np.abs(rough[:, :3, 3] - frames()[:, :3, 3]).max() < 0.3
    distance, _, missed_m = calibration_error(
        observations, FROM_NOTHING, replace(TRUE, frames=rough, latencies_s=np.zeros(3))
    )
    assert distance < 36.1
    assert np.linalg.norm(missed_m, axis=1).max() < 1e-3


def test_prism_layout_is_calibrated() -> None:
    """A prism displaced by 4 mm is found; the robot's origin is unchanged."""
    observations = drive()
    shifted = LAYOUT.copy()
    shifted[2] += [0.004, 0.0, 0.0]
    found = calibrate_motion(
        replace(observations, layout=shifted),
        SetupPrior(prism_sigma_m=0.01),
        prior=MOTION_PRIOR,
        noise_scale=1.0,
    )
    apart = np.linalg.norm(found.setup.layout - np.roll(found.setup.layout, 1, axis=0), axis=1)
    assert apart == pytest.approx(np.linalg.norm(LAYOUT - np.roll(LAYOUT, 1, axis=0), axis=1), abs=5e-4)
    assert found.setup.layout.mean(axis=0) == pytest.approx(shifted.mean(axis=0), abs=1e-9)
    assert found.prism_sigmas_m().max() < 5e-4


def test_setup_jacobian_is_exact() -> None:
    """Each parameter's derivative equals central differences."""
    observations = drive(10.0)
    setup = Setup.of(observations)
    unknowns = SetupParameters.of_observations(observations, setup)
    knots = initial_guess(observations, knot_times(observations.time_s))
    at = np.arange(len(observations))
    exact = unknowns.jacobian(observations, linearise(observations, knots, at), setup)
    for unknown in range(unknowns.count):
        residuals = []
        for step in (1e-6, -1e-6):
            changed = unknowns.retract(setup, step * (np.arange(unknowns.count) == unknown))
            residuals.append(linearise(changed.applied(observations), knots, at).residuals_m)
        assert exact[:, :, unknown] == pytest.approx((residuals[0] - residuals[1]) / 2e-6, abs=2e-6)


def test_local_coordinates_invert_a_step() -> None:
    """The difference of a changed set-up from the reference is the change."""
    observations = drive(10.0)
    unknowns = SetupParameters.of_observations(observations, Setup.of(observations))
    step = np.random.default_rng(1).normal(scale=1e-3, size=unknowns.count)
    found = unknowns.local_coordinates(unknowns.retract(unknowns.reference, step))
    assert found == pytest.approx(step, abs=1e-12)


@pytest.mark.slow
def test_straight_drive_is_unobservable() -> None:
    """Driving straight on level ground leaves rotations about the path unobservable; a winding path leaves none."""
    straight = calibrate_motion(drive(30.0, straight=True), REFINE, prior=MOTION_PRIOR, noise_scale=1.0)
    assert any(
        "station 2 turns by" in description and "mrad about bearing" in description
        for description in unobservable_directions(straight)
    )
    assert (
        unobservable_directions(calibrate_motion(drive(), REFINE, prior=MOTION_PRIOR, noise_scale=1.0)) == []
    )


def test_station_1_is_needed() -> None:
    """Frames and latencies are relative to station 1."""
    observations = drive(20.0)
    with pytest.raises(GeometryError, match="station 1 has measured nothing"):
        calibrate_motion(observations.select(observations.station > 0), REFINE, prior=MOTION_PRIOR)


def test_nothing_to_estimate_is_rejected() -> None:
    """With everything fixed there is nothing to estimate."""
    with pytest.raises(GeometryError, match="nothing to estimate"):
        calibrate_motion(drive(20.0), SetupPrior(), prior=MOTION_PRIOR)


def test_stationary_robot_is_rejected() -> None:
    """Without motion there is nothing to align."""
    with pytest.raises(GeometryError, match="no further than"):
        frames_from_motion(drive(20.0, still=True))


def test_tracks_without_common_epochs_are_rejected() -> None:
    """Two stations need ten seconds in common."""
    observations = drive(40.0)
    apart = (observations.station != 1) == (observations.time_s < 30.0)
    with pytest.raises(GeometryError, match="stations 1 and 2 have only"):
        frames_from_motion(observations.select(apart))
