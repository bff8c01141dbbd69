"""What a drive has not shown: how lively a robot is taken to be, when it is hidden, and a bend that nobody saw."""

from __future__ import annotations

import numpy as np
import pytest
from harness.prior_motion import STEP_S, measure, rows_at, sorted_by_time

from tsgt.geometry import States, exp_so3, log_so3
from tsgt.geometry.trajectory import fit_trajectory, with_noise_floor
from tsgt.geometry.trajectory.hyperparameters import partially_occluded
from tsgt.geometry.trajectory.motion_prior import axis_sigmas
from tsgt.model import MotionPrior, PipelineParameters

PRIOR = MotionPrior()
UNTIL_S = 80.0
BEND_S = (38.0, 42.0)
BEND_RAD = np.radians(70.0)
HIDDEN_S = (36.0, 44.0)


def straight_but_for_a_bend() -> States:
    """Drive at a metre per second, straight but for one bend."""
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
def test_a_bend_in_an_outage_gives_no_valid_pose_beyond_six_sigmas(seen: tuple[int, ...]) -> None:
    """A robot that went straight while it was seen, and bends while at most some prisms are, is not taken to go straight."""
    motion = straight_but_for_a_bend()
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


def test_the_livelier_prior_holds_axis_by_axis() -> None:
    """What is livelier stays; what is calmer comes up to the share, at its own correlation time."""
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


def test_a_prior_is_at_least_itself() -> None:
    """Nothing changes by it."""
    np.testing.assert_allclose(axis_sigmas(with_noise_floor(PRIOR, PRIOR)), axis_sigmas(PRIOR))


def test_a_robot_is_hidden_while_fewer_than_three_prisms_are_seen() -> None:
    """With four prisms one may be missing; two may not, and before the first measurement none is seen."""
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
