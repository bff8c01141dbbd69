"""Wheel odometry between knots: Jacobians, displacement in a turn, gaps, slip."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial.inertial_drive import GRADES, imu_parameters, inertial_drive
from scipy.spatial.transform import Rotation

from tsgt.geometry.inertial import (
    InertialFixedLagSmoother,
    InertialSamples,
    InertialStates,
    Mounting,
    contiguous,
    fit_inertial_trajectory,
)
from tsgt.geometry.inertial.odometry import (
    Odometry,
    OdometrySteps,
    WheelSamples,
    add_wheel_processes,
    linearise_odometry,
)
from tsgt.model import MotionPrior, OdometryParameters

if TYPE_CHECKING:
    from collections.abc import Callable

    from harness.inertial.inertial_drive import InertialDrive

    from tsgt.geometry import FloatArray

PARAMETERS = OdometryParameters(
    position_m=(-0.3, 0.1, 0.05),
    orientation_xyzw=(0.0, 0.0, 0.0998334, 0.9950042),
)
MOUNTING = Mounting(Rotation.from_euler("xyz", [0.1, -0.2, 1.0]).as_matrix(), np.array([0.2, 0.0, 0.5]))
RATE_RADPS = 0.8


def turning(end_s: float = 2.0) -> tuple[Odometry, InertialStates, InertialSamples]:
    """Return exact odometry of a circle at 1.2 m/s, at 20 Hz, states of the IMU every 0.25 s, and its samples."""
    step_s = np.arange(0.05, end_s + 1e-9, 0.05)
    samples = WheelSamples(step_s, np.full(len(step_s), 0.05), np.full(len(step_s), 1.2))
    odometry = Odometry.of(samples, PARAMETERS, MOUNTING, np.zeros(3))
    time_s = np.arange(0.0, end_s + 1e-9, 0.25)
    yaw = RATE_RADPS * time_s
    wheels = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    radius_m = 1.2 / RATE_RADPS
    point = radius_m * np.stack([np.sin(yaw), 1.0 - np.cos(yaw), np.zeros_like(yaw)], axis=1)
    rotation = wheels @ odometry.axes.T
    zero = np.zeros((len(time_s), 3))
    states = InertialStates(time_s, point - rotation @ odometry.arm_m, rotation, zero, zero, zero, zero)
    imu_s = np.arange(0.005, end_s + 1e-9, 0.005)
    rate = np.tile(odometry.axes @ [0.0, 0.0, RATE_RADPS], (len(imu_s), 1))
    return odometry, states, InertialSamples(imu_s, np.full(len(imu_s), 0.005), rate, np.zeros_like(rate))


def steps_of(odometry: Odometry, states: InertialStates, samples: InertialSamples) -> OdometrySteps:
    """Return the steps between all states."""
    present = contiguous(samples, GRADES["industrial"])
    return odometry.between(present, states.time_s[:-1], states.time_s[1:], states.gyro_bias[:-1])


def test_exact_odometry_in_a_turn_has_no_residual() -> None:
    """The wheels' point, off the IMU and in other axes, moves along the arc."""
    odometry, states, samples = turning()
    rows = linearise_odometry(states, steps_of(odometry, states, samples))
    # The chords of samples of 50 ms are shorter than the arc by 0.1 mm per metre.
    assert np.abs(rows[:, :, -1]).max() < 0.05


def test_rows_equal_differences() -> None:
    """Jacobians by both states, by scale, slip and direction among them."""
    odometry, states, samples = turning(0.5)
    rng = np.random.default_rng(0)
    states = states.retract(rng.normal(scale=0.05, size=(3, 18)))
    steps = steps_of(odometry, states, samples)
    rows = linearise_odometry(states, steps)
    scale = np.abs(rows[:, :, :-1]).max()
    h = 1e-6
    for knot in range(3):
        for column in range(18):
            error = np.zeros((3, 18))
            error[knot, column] = h
            difference = (
                linearise_odometry(states.retract(error), steps)[:, :, -1]
                - linearise_odometry(states.retract(-error), steps)[:, :, -1]
            ) / (2 * h)
            for step in range(2):
                own = knot - step in (0, 1)
                expected = rows[step, :, 18 * (knot - step) + column] if own else np.zeros(3)
                np.testing.assert_allclose(difference[step] / scale, expected / scale, atol=1e-7)
    assert not rows[:, :, 36:-1].any()


def test_processes_equal_their_density() -> None:
    """Cost and gradient are those of Gauss-Markov steps; the covariance of slip stays that of its prior."""
    odometry, states, samples = turning(0.5)
    steps = steps_of(odometry, states, samples)
    wheels = np.random.default_rng(1).normal(scale=0.02, size=(3, 3))

    def cost(values: np.ndarray) -> float:
        return float(((values[1:] - steps.kept * values[:-1]) ** 2 / steps.variances).sum())

    diagonal, off_diagonal, gradient = np.zeros((3, 18, 18)), np.zeros((2, 18, 18)), np.zeros((3, 18))
    assert add_wheel_processes(wheels, steps, diagonal, off_diagonal, gradient) == pytest.approx(cost(wheels))
    h = 1e-5
    for knot in range(3):
        for column in range(3):
            moved = wheels.copy()
            moved[knot, column] += h
            back = wheels.copy()
            back[knot, column] -= h
            difference = (cost(moved) - cost(back)) / (4 * h)
            assert gradient[knot, 15 + column] == pytest.approx(difference, rel=1e-5)
    diagonal[0, 15:, 15:] += np.diag(odometry.prior_sigmas() ** -2.0)
    slip = diagonal[:, 16, 16] * np.eye(3)
    slip[[0, 1], [1, 2]] = slip[[1, 2], [0, 1]] = off_diagonal[:, 16, 16]
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(slip))), PARAMETERS.slip_sigma, rtol=1e-9)


def test_a_step_without_samples_says_nothing() -> None:
    """Samples are missing from 0.4 to 0.6 s: the two steps that they leave mostly uncovered have no weight."""
    odometry, states, samples = turning(1.0)
    kept = (odometry.samples.end_s < 0.41) | (odometry.samples.end_s > 0.64)
    steps = steps_of(replace(odometry, samples=odometry.samples.select(kept)), states, samples)
    np.testing.assert_array_equal(steps.whitening.any(axis=(1, 2)), [True, False, False, True])
    np.testing.assert_array_equal(linearise_odometry(states, steps)[1:3], 0.0)


def test_large_slip_is_noisy() -> None:
    """Its noise keeps it at two sigmas; that of scale and direction stays, as do steps with the slip that was configured."""
    odometry, states, samples = turning(1.0)
    steps = steps_of(odometry, states, samples)
    sigma = PARAMETERS.slip_sigma
    found = steps.with_slip(sigma * np.array([0.0, 1.9, 6.0, -3.0, 0.0]))
    np.testing.assert_allclose(found.slip_noise, [1.0, 9.0, 9.0, 2.25])
    ratio = found.process_variances() / steps.process_variances()
    np.testing.assert_allclose(ratio[:, 1], found.slip_noise)
    np.testing.assert_array_equal(ratio[:, [0, 2]], 1.0)
    np.testing.assert_array_equal(found.with_slip(np.zeros(5)).slip_noise, 1.0)


def driven(drive: InertialDrive) -> WheelSamples:
    """Return exact samples of a drive of 31 s at 20 Hz."""
    position, rotation = drive.pose_at(np.arange(0.0, 31.0, 0.05))
    moved = np.einsum("nji,nj->ni", rotation[:-1], np.diff(position, axis=0))[:, 0]
    end_s = np.arange(0.05, 0.05 * len(position) - 0.01, 0.05)
    return WheelSamples(end_s, np.full(len(end_s), 0.05), moved / 0.05)


@pytest.mark.slow
def test_wheels_that_slide_do_not_change_the_scale() -> None:
    """Post-processed and live, six seconds 30 % too slow; the robot has stood until shortly before."""
    imu = imu_parameters()
    drive = inertial_drive(31.0, seed=12)
    samples, observations = drive.samples(imu), drive.measure()
    right = driven(drive)
    sliding = np.where((right.end_s > 22.0) & (right.end_s < 28.0), 0.7, 0.99)
    wheels = replace(right, speed_mps=sliding * right.speed_mps)
    odometry = wheels, OdometryParameters()
    fit = fit_inertial_trajectory(observations, samples, imu, reference_m=np.zeros(3), odometry=odometry)
    assert fit.wheels is not None
    knots = fit.trajectory.knots
    inside = (knots.time_s > 23.0) & (knots.time_s < 27.0)
    assert fit.wheels.rejected[inside[:-1]].mean() > 0.9
    assert fit.wheels.rejected[~inside[:-1]].mean() < 0.3
    np.testing.assert_array_less(np.abs(knots.wheels[:, 0] - 0.01), 2.5 * fit.wheels.sigmas[:, 0])

    window = InertialFixedLagSmoother(
        imu, MotionPrior(), reference_m=np.zeros(3), odometry=OdometryParameters()
    )
    for now_s in np.arange(0.5, 30.5, 0.5):
        window.add_samples(samples.select((samples.end_s <= now_s) & (samples.end_s > now_s - 0.5)))
        window.add_odometry(wheels.select((wheels.end_s <= now_s - 0.1) & (wheels.end_s > now_s - 0.6)))
        measured = (observations.time_s <= now_s - 0.3) & (observations.time_s > now_s - 0.8)
        if measured.any():
            window.update(observations.select(measured))
        window.marginalise_before(now_s - 3.0)
        if now_s == 26.5:
            assert window.wheels is not None
            assert (window.wheels.rejected_share or 0.0) > 0.8
    assert window.wheels is not None
    assert abs(window.wheels.values[0] - 0.01) < 2.5 * window.wheels.sigmas[0]


@pytest.mark.slow
def test_outage_with_odometry() -> None:
    """Fourteen seconds without measurements: wheels with 2 % of scale do no harm although they spin for two seconds."""
    imu = imu_parameters()
    drive = inertial_drive(31.0, seed=12)
    samples, observations = drive.samples(imu), drive.measure()
    observations = observations.select((observations.time_s < 13.0) | (observations.time_s > 27.0))
    step_s = np.arange(0.05, 31.0, 0.05)
    position, rotation = drive.pose_at(step_s - 0.05)
    moved = drive.pose_at(step_s)[0] - position
    speed = 0.98 * np.einsum("nji,nj->ni", rotation, moved)[:, 0] / 0.05
    speed[(step_s > 21.0) & (step_s < 23.0)] *= 1.3
    wheels = WheelSamples(step_s, np.full(len(step_s), 0.05), speed)
    time_s = np.arange(14.0, 26.0, 0.1)
    truth = drive.pose_at(time_s)[0]
    errors = []
    for odometry in (None, (wheels, OdometryParameters())):
        found = fit_inertial_trajectory(
            observations, samples, imu, reference_m=np.zeros(3), odometry=odometry
        ).trajectory
        states, covariance = found.at(time_s)
        error = states.position - truth
        errors.append(np.sqrt((error**2).sum(axis=1).mean()))
        normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance[:, :3, :3]), error)
        assert normalised.mean() < 6.0
    assert errors[1] < 1.05 * errors[0]
    # Of the true speed the measured one is 0.98 times.
    assert found.knots.wheels[-1, :2].sum() == pytest.approx(1 / 0.98 - 1, abs=0.005)


@dataclass
class LiveOutage:
    """Twelve seconds without measurements, live, with wheels of 2 % of scale that turn at ``factors`` of their speed by time."""

    odometry: OdometryParameters | None = None
    factors: Callable[[FloatArray], FloatArray] = np.ones_like

    def __post_init__(self) -> None:
        imu = imu_parameters()
        drive = inertial_drive(31.0, seed=12)
        samples, observations = drive.samples(imu), drive.measure()
        right = driven(drive)
        wheels = replace(right, speed_mps=0.98 * self.factors(right.end_s) * right.speed_mps)
        self.window = InertialFixedLagSmoother(
            imu, MotionPrior(), reference_m=np.zeros(3), odometry=self.odometry
        )
        self.squared_sigmas: list[float] = []
        squares = []
        self.rejected_share: float | None = None
        for now_s in np.arange(0.5, 30.5, 0.5):
            arrived = (samples.end_s <= now_s) & (samples.end_s > now_s - 0.5)
            self.window.add_samples(samples.select(arrived))
            # Half a second late.
            turned = (wheels.end_s <= now_s - 0.5) & (wheels.end_s > now_s - 1.0)
            self.window.add_odometry(wheels.select(turned))
            measured = (observations.time_s <= now_s - 0.3) & (observations.time_s > now_s - 0.8)
            if measured.any() and not 17.0 < now_s < 29.5:
                self.window.update(observations.select(measured))
            self.window.marginalise_before(now_s - 3.0)
            if now_s > 18.0 and self.window.initialised:
                state, covariance = self.window.predict(now_s)
                error = state.position[0] - drive.pose_at(np.array([now_s]))[0][0]
                self.squared_sigmas.append(error @ np.linalg.solve(covariance[0, :3, :3], error))
                squares.append(error @ error)
            if now_s == 23.5 and (found := self.window.wheels) is not None:  # Samples are half a second late
                self.rejected_share = found.rejected_share
        self.error_m = float(np.sqrt(np.mean(squares)))


def between(from_s: float, to_s: float, factor: float) -> Callable[[FloatArray], FloatArray]:
    """Return factors on the speed that are not one for some time."""
    return lambda time_s: np.where((time_s > from_s) & (time_s < to_s), factor, 1.0)


@pytest.mark.slow
def test_live_outage_with_odometry() -> None:
    """Wheels halve the error, with an honest uncertainty. Those that spin, 10 % for two seconds, harm neither."""
    alone = LiveOutage()
    right = LiveOutage(OdometryParameters())
    spinning = LiveOutage(OdometryParameters(), between(21.0, 23.0, 1.1))
    assert alone.window.wheels is None
    for each in (alone, right, spinning):
        assert each.window.converged
        assert np.mean(each.squared_sigmas) < 6.0
        assert np.max(each.squared_sigmas) < 16.0
    assert max(right.error_m, spinning.error_m) < 0.5 * alone.error_m
    assert right.rejected_share == 0.0
    assert spinning.rejected_share is not None
    assert 0.1 < spinning.rejected_share < 0.8
    found = spinning.window.wheels
    assert found is not None
    # Of the true speed the measured one is 0.98 times.
    assert abs(found.values[:2].sum() - (1 / 0.98 - 1)) < 3 * found.sigmas[:2].sum()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.0, 0.7])
def test_wheels_that_are_wrong_for_long_do_not_count_again_by_chance(factor: float) -> None:
    """The longer the IMU goes on alone, the less it can contradict them."""
    wrong = LiveOutage(OdometryParameters(), between(18.0, 40.0, factor))
    assert wrong.window.converged
    assert np.max(wrong.squared_sigmas) < 16.0
    assert wrong.error_m < 1.5 * LiveOutage().error_m


def test_odometry_without_an_imu_is_not_held_for_ever() -> None:
    """An IMU that is never found leaves wheels that are used for nothing."""
    window = InertialFixedLagSmoother(
        imu_parameters(), MotionPrior(), reference_m=np.zeros(3), odometry=PARAMETERS
    )
    for now_s in np.arange(1.0, 100.0):
        end_s = now_s + np.arange(-0.9, 0.01, 0.1)
        window.add_odometry(WheelSamples(end_s, np.full(10, 0.1), np.ones(10)))
        window.marginalise_before(now_s - 3.0)
    assert window._held.odometry is not None
    assert len(window._held.odometry.samples) < 50


def test_lost_trajectory_does_not_hold_samples_for_ever() -> None:
    """It predicts from its newest knot, but not after minutes without measurements."""
    imu = imu_parameters()
    drive = inertial_drive(6.0, seed=12)
    samples, observations = drive.samples(imu), drive.measure()
    window = InertialFixedLagSmoother(imu, MotionPrior(), reference_m=np.zeros(3), odometry=PARAMETERS)
    window.add_samples(samples)
    window.update(observations)
    window._converged = False  # As when it does not explain the newest measurements
    one = samples.select(slice(1))
    for now_s in np.arange(7.0, 400.0):
        window.add_samples(replace(one, end_s=np.array([now_s])))
        window.add_odometry(WheelSamples(np.array([now_s]), np.ones(1), np.ones(1)))
        window.marginalise_before(now_s - 3.0)
    assert not window.initialised
    assert window._held.odometry is not None
    assert max(len(window._held.imu), len(window._held.odometry.samples)) < 50
