"""A wrong configuration of an IMU is noticed, with its cause; a right one is not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial.imu_calibration import uncalibrated_drive

from tsgt.geometry import exp_so3
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.inertial_calibration import SetupCheck, SetupFinding, check_imu_setup
from tsgt.geometry.inertial_calibration.setup_check import GROSS, certain_bound

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import Gravity, InertialSamples, Mounting
    from tsgt.geometry.trajectory import Observations, Trajectory
    from tsgt.model import ImuNoise

DEG = np.pi / 180


@pytest.mark.parametrize("variance", [1e-24, 0.0, -1e-24])
def test_bound_of_a_rotation_that_nothing_tells(variance: float) -> None:
    """It is as configured; the rounding of its covariance, of either sign, makes it no NaN, which no limit would be below."""
    assert certain_bound(np.zeros(3), variance * np.eye(3)) == pytest.approx(0.0, abs=1e-9)


def test_bound_adds_two_sigmas_of_the_least_certain_direction() -> None:
    """Of three components together."""
    assert certain_bound(np.array([0.3, 0.0, 0.4]), np.diag([0.01, 0.04, 0.01])) == pytest.approx(0.9)


@dataclass(frozen=True)
class Configured:
    """A drive of 50 s with an IMU as it is configured; exactly, unless changed."""

    observations: Observations
    trajectory: Trajectory
    samples: InertialSamples
    mounting: Mounting
    noise: ImuNoise
    gravity: Gravity

    def check(self) -> SetupCheck:
        """Check it."""
        return check_imu_setup(
            self.observations, self.trajectory, self.samples, self.mounting, self.noise, self.gravity
        )

    def sampled(self, rates: FloatArray, forces: FloatArray | None = None, late_s: float = 0.0) -> Configured:
        """Return samples that are multiplied by matrices, and late."""
        samples = replace(
            self.samples,
            end_s=self.samples.end_s + late_s,
            angular_rate_radps=self.samples.angular_rate_radps @ rates.T,
            specific_force_mps2=self.samples.specific_force_mps2 @ (rates if forces is None else forces).T,
        )
        return replace(self, samples=samples)

    def turning(self, share: FloatArray) -> Configured:
        """Return the robot with shares, (K,), of its rates at the knots."""
        knots = self.trajectory.knots
        knots = replace(knots, angular_velocity=share[:, None] * knots.angular_velocity)
        return replace(self, trajectory=replace(self.trajectory, knots=knots))


@cache
def drive(grade: str = "industrial", seed: int = 0, alone_from_s: float = np.inf) -> Configured:
    """Drive, with samples as the estimator takes them; from some time on one prism alone is measured."""
    found = uncalibrated_drive(50.0, grade=grade, seed=seed)
    measured = found.observations
    fit = fit_trajectory(measured.select((measured.time_s < alone_from_s) | (measured.prism == 0)))
    samples = replace(
        found.samples,
        end_s=found.samples.end_s - found.truth.latency_s,
        angular_rate_radps=found.samples.angular_rate_radps @ found.truth.gyro_matrix.T,
    )
    return Configured(
        fit.observations, fit.trajectory, samples, found.truth.mounting, found.imu.noise, found.gravity
    )


def only(check: SetupCheck) -> SetupFinding:
    """Return the only finding."""
    (finding,) = check.findings
    return finding


EACH_AXIS = [2, *(pytest.param(axis, marks=pytest.mark.slow) for axis in (0, 1))]


@pytest.mark.slow
@pytest.mark.parametrize("axis", EACH_AXIS)
def test_mounting_one_degree_off(axis: int) -> None:
    """A degree about any axis is named with its size."""
    right = drive()
    turn = exp_so3(DEG * np.eye(3)[axis])
    wrong = replace(right, mounting=replace(right.mounting, rotation=right.mounting.rotation @ turn))
    finding = only(wrong.check())
    assert finding.cause == "rotation"
    assert finding.size == pytest.approx(DEG, abs=max(4 * finding.sigma, 0.1 * DEG))
    assert "the mounting of the IMU is wrong by" in finding.text


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["industrial", "consumer"])
@pytest.mark.parametrize("axis", [0, 1])
def test_tilt_of_three_tenths_of_a_degree(axis: int, grade: str) -> None:
    """About a horizontal axis of the robot it tilts the poses by most of it, and is named with its size."""
    right = drive(grade)
    turn = exp_so3(0.3 * DEG * np.eye(3)[axis])
    check = replace(right, mounting=replace(right.mounting, rotation=turn @ right.mounting.rotation)).check()
    assert "rotation" not in check.excluded
    finding = only(check)
    assert finding.cause == "rotation"
    assert finding.size == pytest.approx(0.3 * DEG, abs=4 * finding.sigma)
    assert not check.confirmed


@pytest.mark.parametrize("axis", EACH_AXIS)
@pytest.mark.slow
def test_lever_arm_100_mm_off(axis: int) -> None:
    """A decimetre along any axis is named with its size."""
    right = drive()
    position = right.mounting.position + 0.1 * np.eye(3)[axis]
    finding = only(replace(right, mounting=replace(right.mounting, position=position)).check())
    assert finding.cause == "position"
    assert finding.size == pytest.approx(0.1, abs=max(4 * finding.sigma, 0.005))


@pytest.mark.parametrize("late_s", [-0.01, 2.0])
def test_clock_off(late_s: float) -> None:
    """Ten milliseconds and two seconds are named with their size."""
    finding = only(drive().sampled(np.eye(3), late_s=late_s).check())
    assert finding.cause == "latency"
    assert finding.size == pytest.approx(abs(late_s), abs=0.002)
    assert ("stamps are +" in finding.text) == (late_s > 0)


def test_swapped_axes() -> None:
    """Axes in another order are described."""
    swapped = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    finding = only(drive().sampled(swapped).check())
    assert finding.cause == "axes"
    assert "its x is the configured -y, its y is the configured x, its z is the configured z" in finding.text


def test_left_handed_axes() -> None:
    """Two exchanged axes are no rotation."""
    finding = only(drive().sampled(np.eye(3)[[1, 0, 2]]).check())
    assert finding.cause == "axes"
    assert "left-handed" in finding.text


def test_wrong_units() -> None:
    """Degrees per second and multiples of gravity are recognised."""
    right = drive()
    rates = only(right.sampled(np.eye(3) / DEG, np.eye(3)).check())
    assert (rates.cause, rates.text.count("degrees per second")) == ("unit_of_rate", 1)
    forces = only(right.sampled(np.eye(3), np.eye(3) / 9.81).check())
    assert (forces.cause, forces.text.count("g instead of")) == ("unit_of_force", 1)


def test_sign_of_gravity() -> None:
    """A device that gives accelerations with gravity pointing down."""
    assert only(drive().sampled(np.eye(3), -np.eye(3)).check()).cause == "gravity_sign"


def test_samples_of_another_robot() -> None:
    """Rates that have nothing to do with the robot's."""
    right = drive()
    reversed_rates = right.samples.angular_rate_radps[::-1].copy()
    other = replace(right, samples=replace(right.samples, angular_rate_radps=reversed_rates))
    assert only(other.check()).cause == "unrelated"


def test_robot_at_rest_tells_nothing() -> None:
    """Without turning there is no finding, whatever is wrong."""
    right = drive().sampled(np.eye(3) / DEG)
    assert right.turning(np.zeros(len(right.trajectory.knots))).check() == SetupCheck()


@pytest.mark.parametrize("grade", ["industrial", pytest.param("consumer", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_right_setup_is_not_reported(grade: str) -> None:
    """No false alarm; what harms is ruled out."""
    check = drive(grade).check()
    assert check.findings == ()
    assert check.excluded >= {"axes", "latency"}
    assert check.confirmed


@pytest.mark.slow
def test_one_prism_alone_is_not_another_robot() -> None:
    """When the robot drives where one station alone sees it, the stations do not tell its rates there."""
    check = drive(alone_from_s=42.0).check()
    assert check.findings == ()
    assert check.confirmed


@pytest.mark.slow
def test_robot_that_rolls_over_has_the_same_imu() -> None:
    """Its prisms are hidden as soon as it has rolled by 45 degrees, and seen again when it stands: they do not tell the fast turn."""
    sound = drive()
    lying = (sound.observations.time_s > 25.7) & (sound.observations.time_s < 31.8)
    fit = fit_trajectory(sound.observations.select(~lying))
    rates = sound.samples.angular_rate_radps.copy()
    for from_s, sign in ((25.0, 1.0), (31.0, -1.0)):
        progress = np.clip((sound.samples.end_s - from_s) / 1.5, 0.0, 1.0)
        rates[:, 0] += sign * np.radians(110.0) / 1.5 * 30.0 * progress**2 * (1.0 - progress) ** 2
    rolled = replace(
        sound,
        observations=fit.observations,
        trajectory=fit.trajectory,
        samples=replace(sound.samples, angular_rate_radps=rates),
    )
    assert not {finding.cause for finding in rolled.check().findings} & GROSS


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["industrial", "consumer"])
def test_no_false_alarm_on_clean_drives(grade: str) -> None:
    """Eight drives of each class; `benchmarks/run.py imu_setup` has more."""
    for seed in range(8):
        assert drive(grade, 100 + seed).check().findings == (), seed


@pytest.mark.parametrize(
    "held",
    [
        lambda time_s: (time_s < 3.0) | (time_s > 47.0),  # back after a silence
        lambda time_s: time_s % 1.0 < 0.45,  # gaps all the time
        lambda time_s: time_s > 1e9,
        lambda time_s: np.isin(np.arange(len(time_s)), (3, 2000)),
    ],
)
@pytest.mark.slow
def test_few_samples_tell_nothing(held: Callable[[FloatArray], NDArray[np.bool_]]) -> None:
    """Silences of the IMU are no error of its set-up."""
    right = drive()
    samples = right.samples.select(held(right.samples.end_s))
    assert replace(right, samples=samples).check().findings == ()


def test_rest_of_the_turning_robot_tells_no_unit() -> None:
    """Samples of a part of the drive are compared with the robot's rates of that part."""
    right = drive()
    quiet = right.turning((right.trajectory.knots.time_s < 25.0).astype(float))
    samples = right.samples.select(right.samples.end_s > 30.0)
    samples = replace(samples, angular_rate_radps=0.02 * samples.angular_rate_radps)
    assert replace(quiet, samples=samples).check() == SetupCheck()


def test_imu_that_was_lost_before_the_robot_stood() -> None:
    """While both are known the robot turns enough, but not over the whole drive: that says nothing of whose rates they are."""
    right = drive()
    time_s, rate = right.trajectory.knots.time_s, right.trajectory.knots.angular_velocity
    early = time_s < 20.0
    slow = 0.042 / float(np.sqrt(np.var(rate[early], axis=0).sum()))
    found = right.turning(np.where(early, slow, 0.0)).sampled(slow * np.eye(3), np.eye(3))
    samples = found.samples.select(found.samples.end_s < 20.0)
    assert replace(found, samples=samples).check() == SetupCheck()
