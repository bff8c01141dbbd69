"""Hyperparameters: maximum-evidence tuning, process-noise floor and occlusion."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.prior_motion import STEP_S, draw_motions, measure, rows_at, sorted_by_time
from harness.drives.slow_motion import braking, measure_along

from tsgt.errors import GeometryError
from tsgt.geometry import exp_so3, log_so3
from tsgt.geometry.batch import fit_trajectory, hyperparameters, scale_noise, tune, with_noise_floor
from tsgt.geometry.batch.hyperparameters import MIN_MEASUREMENTS, partially_occluded
from tsgt.geometry.rest import find_rest, in_rest
from tsgt.geometry.trajectory import States
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.model import MotionPrior, PipelineParameters

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import Observations

PRIOR = MotionPrior()
UNTIL_S = 80.0
BEND_S = (38.0, 42.0)
BEND_RAD = np.radians(70.0)
HIDDEN_S = (36.0, 44.0)


def straight_with_one_bend() -> States:
    """Drive at 1 m/s, straight except for one bend."""
    time_s = np.arange(0.0, UNTIL_S + 1.0, STEP_S)
    share = np.clip((time_s - BEND_S[0]) / (BEND_S[1] - BEND_S[0]), 0.0, 1.0)
    yaw = BEND_RAD * (share - np.sin(2 * np.pi * share) / (2 * np.pi))
    about_z = np.stack([0 * yaw, 0 * yaw, yaw], axis=1)
    velocity = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    rates = np.gradient(about_z, STEP_S, axis=0)
    return States(
        time_s,
        np.cumsum(velocity, axis=0) * STEP_S,
        exp_so3(about_z),
        velocity,
        rates,
        np.gradient(velocity, STEP_S, axis=0),
        np.gradient(rates, STEP_S, axis=0),
    )


@pytest.mark.parametrize("seen", [(), (0,), (0, 2)])
@pytest.mark.slow
def test_bend_during_an_outage_stays_within_six_sigmas(seen: tuple[int, ...]) -> None:
    """A robot that drives straight while observed and bends while occluded stays within the covariance of valid poses."""
    motion = straight_with_one_bend()
    whole = sorted_by_time(measure(motion, until_s=UNTIL_S, seed=3))
    inside = (whole.time_s > HIDDEN_S[0]) & (whole.time_s < HIDDEN_S[1])
    found = fit_trajectory(whole.select(~inside | np.isin(whole.prism, seen))).trajectory
    at_s = np.arange(30.0, 50.0, 0.1)
    states, covariance = found.at(at_s, dim=6)
    truth = motion.select(rows_at(at_s))
    limits = PipelineParameters()
    rotation, position = covariance[:, 3:, 3:], covariance[:, :3, :3]
    valid = (np.linalg.eigvalsh(rotation)[:, -1] < limits.rotation_sigma_limit_rad**2) & (
        np.linalg.eigvalsh(position)[:, -1] < limits.position_sigma_limit_m**2
    )
    turned = log_so3(np.swapaxes(states.rotation, 1, 2) @ truth.rotation)
    for error, spread in ((turned, rotation), (truth.position - states.position, position)):
        squared = np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[..., None])[..., 0])
        assert squared[valid].max() < 6.0**2
    measured = (at_s < HIDDEN_S[0]) | (at_s > HIDDEN_S[1])
    assert valid[measured].all()


def test_noise_floor_acts_per_axis() -> None:
    """Axes above the floor are kept; others are raised to the share at their own correlation time."""
    calm = MotionPrior(
        acceleration_sigma_mps2=(1.0, 1.0, 0.001),
        acceleration_correlation_time_s=0.2,
        angular_acceleration_sigma_radps2=(0.5, 0.5, 0.003),
        angular_acceleration_correlation_time_s=0.1,
    )
    found = with_noise_floor(calm, PRIOR, 0.5)
    raised = 0.5 * 0.2 * np.sqrt((0.8 / (1 + 0.8**2)) / (0.2 / (1 + 0.2**2)))
    turning = 0.5 * 0.2 * np.sqrt((0.4 / (1 + 0.4**2)) / (0.1 / (1 + 0.1**2)))
    assert found.acceleration_sigma_mps2 == pytest.approx((1.0, 1.0, raised))
    assert found.angular_acceleration_sigma_radps2 == pytest.approx((0.5, 0.5, turning))
    assert (found.acceleration_correlation_time_s, found.angular_acceleration_correlation_time_s) == (
        0.2,
        0.1,
    )


def test_noise_floor_of_the_prior_itself_changes_nothing() -> None:
    """A prior is not below itself."""
    np.testing.assert_allclose(axis_sigmas(with_noise_floor(PRIOR, PRIOR)), axis_sigmas(PRIOR))


def test_partially_occluded_below_three_prisms() -> None:
    """With four prisms one may be missing, two may not; before the first measurement none is observed."""
    time_s = np.arange(0.0, 10.0, 0.1)
    prism = np.arange(len(time_s)) % 4
    gone = (time_s > 3.0) & (time_s < 7.0) & (prism == 0)
    also = (time_s > 5.0) & (time_s < 9.0) & (prism == 1)
    kept = ~(gone | also)
    at_s = np.array([-1.0, 2.0, 4.0, 6.0, 8.0, 20.0])
    assert partially_occluded(time_s[kept], prism[kept], at_s).tolist() == [
        True,
        False,
        False,
        True,
        False,
        True,
    ]


DRAWN_PRIOR = MotionPrior(
    acceleration_sigma_mps2=(0.5, 0.5, 0.2),
    acceleration_correlation_time_s=0.8,
    angular_acceleration_sigma_radps2=(0.2, 0.2, 0.4),
    angular_acceleration_correlation_time_s=0.5,
)


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Measure a minute and a half of a robot that moves as :data:`DRAWN_PRIOR` says."""
    motion = draw_motions(DRAWN_PRIOR, count=1, duration_s=91.0, seed=11)[0]
    return sorted_by_time(measure(motion, until_s=90.0, seed=12))


@pytest.mark.parametrize("stops", [False, True])
def test_evidence_gradient_agrees_with_differences(observations: Observations, *, stops: bool) -> None:
    """Central differences of the evidence, with uncertain timestamps."""
    if stops:
        observations = measure_along(braking(0.5, 8.0, 2.0), until_s=20.0, seed=4)
    segment = hyperparameters._Segment(observations.select(slice(0, 150)))
    assert bool(segment.rest) == stops
    rng = np.random.default_rng(3)
    at = np.concatenate([np.log([0.3, 0.15, 0.5, 0.12, 0.2, 0.4]), rng.uniform(-0.3, 0.7, 9), [-0.3]])
    hyperparameters._evidence(segment, at)
    gradient = hyperparameters._evidence(segment, at).gradient
    step = 1e-3
    for i in range(len(at)):
        aside = step * np.eye(len(at))[i]
        up, down = (hyperparameters._evidence(segment, at + sign * aside).value for sign in (1, -1))
        assert gradient[i] == pytest.approx((up - down) / (2 * step), rel=0.05, abs=0.5)


@pytest.mark.slow
def test_average_information_is_close_to_the_curvature(observations: Observations) -> None:
    """Central differences of the gradient; the rest is chance."""
    segment = hyperparameters._Segment(observations.select(slice(0, 300)))
    at = hyperparameters.log_parameters(DRAWN_PRIOR, np.ones((3, 3)))
    information = hyperparameters._evidence(segment, at).information
    step = 0.02
    curvature = np.array([
        (
            hyperparameters._evidence(segment, at - aside).gradient
            - hyperparameters._evidence(segment, at + aside).gradient
        ) / (2 * step)
        for aside in step * np.eye(len(at))
    ])  # fmt: skip
    scale = np.sqrt(np.diag(information) + 1.0)
    assert np.sqrt(np.mean(((information - curvature) / np.outer(scale, scale)) ** 2)) < 0.15
    assert np.linalg.eigvalsh(information)[0] > -1e-6 * scale.max() ** 2


def test_stop_does_not_lower_the_process_noise() -> None:
    """Another minute at rest leaves the prior of the drive as it is, within what a shorter drive finds."""

    def back_and_forth(time_s: FloatArray) -> FloatArray:
        return 2.0 * np.sin(0.4 * np.minimum(time_s, 10 * np.pi)) ** 4

    whole = measure_along(back_and_forth, until_s=90.0, seed=13)
    drive = whole.select(whole.time_s < 35.0)
    assert find_rest(whole)[-1].end_s > 85.0
    shorter, longer = (tune(each, noise_scale=1.0).prior for each in (drive, whole))
    np.testing.assert_allclose(axis_sigmas(longer)[:2], axis_sigmas(shorter)[:2], rtol=0.15)


def test_quiet_measurements_at_rest_do_not_lower_the_noise() -> None:
    """An instrument that is five times better at rest than on the move has the noise of the move."""

    def start_and_stop(time_s: FloatArray) -> FloatArray:
        return 2.0 * np.sin(0.4 * np.minimum(time_s, 10 * np.pi)) ** 4

    observations = measure_along(start_and_stop, until_s=60.0, seed=13)
    quiet = measure_along(start_and_stop, until_s=60.0, seed=13, noise_scale=0.2)
    at_rest = in_rest(find_rest(observations), observations.time_s) >= 0
    assert 0.4 < at_rest.mean() < 0.6
    points_m = np.where(at_rest[:, None], quiet.points_m, observations.points_m)
    found = tune(replace(observations, points_m=points_m))
    assert found.noise_scale == pytest.approx(1.0, rel=0.15)


def test_tuning_recovers_the_prior(observations: Observations) -> None:
    """Acceleration sigmas within 30 %, noise within 15 %."""
    found = tune(scale_noise(observations, 0.5))
    np.testing.assert_allclose(
        found.prior.acceleration_sigma_mps2, DRAWN_PRIOR.acceleration_sigma_mps2, rtol=0.3
    )
    np.testing.assert_allclose(
        found.prior.angular_acceleration_sigma_radps2, DRAWN_PRIOR.angular_acceleration_sigma_radps2, rtol=0.3
    )
    assert found.prior.acceleration_correlation_time_s == pytest.approx(
        DRAWN_PRIOR.acceleration_correlation_time_s, rel=0.5
    )
    assert found.prior.angular_acceleration_correlation_time_s == pytest.approx(
        DRAWN_PRIOR.angular_acceleration_correlation_time_s, rel=0.5
    )
    assert found.noise_scale == pytest.approx(2.0, rel=0.15)


def test_noise_is_tuned_by_station_and_component() -> None:
    """Factors of 0.6 to four, different for each station and component, are recovered where the robot moves calmly."""
    calm = replace(
        DRAWN_PRIOR,
        acceleration_sigma_mps2=(0.05, 0.05, 0.05),
        angular_acceleration_sigma_radps2=(0.05, 0.05, 0.05),
    )
    motion = draw_motions(calm, count=1, duration_s=61.0, seed=11)[0]
    observations = sorted_by_time(measure(motion, until_s=60.0, seed=12))
    true = np.array([[0.6, 2.0, 1.5], [4.0, 1.0, 1.0], [0.6, 4.0, 3.0]])
    found = tune(scale_noise(observations, 1.0 / true), start=calm)
    assert found.noise_scales == pytest.approx(true, rel=0.25)
    assert found.noise_scale == pytest.approx(np.sqrt(np.mean(true**2)), rel=0.1)


@pytest.mark.slow
def test_start_hardly_affects_the_result(observations: Observations) -> None:
    """From ten times less and ten times more process noise the result is the same."""
    calm = MotionPrior(acceleration_sigma_mps2=(0.05, 0.05, 0.02), acceleration_correlation_time_s=3.0)
    wild = MotionPrior(acceleration_sigma_mps2=(5.0, 5.0, 2.0), acceleration_correlation_time_s=0.1)
    found = [tune(observations, start=start) for start in (calm, wild)]
    assert found[0].log_evidence == pytest.approx(found[1].log_evidence, abs=0.1)
    np.testing.assert_allclose(
        found[0].prior.acceleration_sigma_mps2, found[1].prior.acceleration_sigma_mps2, rtol=0.1
    )


def test_given_values_are_kept(observations: Observations) -> None:
    """A fixed prior and a given noise scale are not changed."""
    few = observations.select(slice(0, 200))
    kept = tune(few, start=DRAWN_PRIOR, noise_only=True)
    np.testing.assert_allclose(kept.prior.acceleration_sigma_mps2, DRAWN_PRIOR.acceleration_sigma_mps2)
    assert kept.prior.acceleration_correlation_time_s == pytest.approx(
        DRAWN_PRIOR.acceleration_correlation_time_s
    )
    assert tune(few, noise_scale=1.5).noise_scale == pytest.approx(1.5)


def test_outliers_do_not_inflate_the_noise(observations: Observations) -> None:
    """One outlier of 400 sigmas in thirty measurements does not double the noise."""
    points = observations.points_m.copy()
    points[::30] += 0.5
    found = tune(replace(observations, points_m=points))
    assert found.noise_scale < 2.0
    np.testing.assert_allclose(
        found.prior.acceleration_sigma_mps2, DRAWN_PRIOR.acceleration_sigma_mps2, rtol=0.5
    )


def test_stationary_robot() -> None:
    """Accelerations become small, the noise scale is right."""
    still = MotionPrior(
        acceleration_sigma_mps2=(1e-6, 1e-6, 1e-6), angular_acceleration_sigma_radps2=(1e-6, 1e-6, 1e-6)
    )
    motion = draw_motions(still, count=1, duration_s=41.0, seed=5)[0]
    rest = replace(
        motion,
        position=np.tile(motion.position[:1], (len(motion), 1)),
        rotation=np.tile(motion.rotation[:1], (len(motion), 1, 1)),
        velocity=np.zeros_like(motion.velocity),
        angular_velocity=np.zeros_like(motion.angular_velocity),
    )
    found = tune(sorted_by_time(measure(rest, until_s=40.0, seed=6)))
    assert max(found.prior.acceleration_sigma_mps2) < 0.02
    assert found.noise_scale == pytest.approx(1.0, rel=0.15)


def test_failed_adaptation_keeps_the_first_result(
    observations: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the adapted process noise makes the equations singular, the result is that without adaptation."""

    def singular(*_: object) -> None:
        raise GeometryError("the measurements do not determine the trajectory")

    few = observations.select(slice(0, 150))
    monkeypatch.setattr(hyperparameters._Segment, "adapt", singular)
    found = tune(few, start=DRAWN_PRIOR, noise_only=True)
    assert 0.5 < found.noise_scale < 2.0


def test_too_few_measurements_are_rejected(observations: Observations) -> None:
    """Some seconds, or two prisms, raise an error that says what is missing."""
    with pytest.raises(GeometryError, match="too few measurements to tune the motion prior"):
        tune(observations.select(slice(0, MIN_MEASUREMENTS - 1)))
    with pytest.raises(GeometryError, match="of at least 3 prisms"):
        tune(observations.select(observations.prism < 2))
