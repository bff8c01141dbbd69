"""States, retraction and local coordinates, process factors."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tsgt.geometry import exp_so3
from tsgt.geometry.trajectory import STATE_DIM, States, concatenate_states
from tsgt.geometry.trajectory.states import (
    LinearisedProcess,
    ProcessFactors,
    add_process_factors,
    axes_to_state,
    linearise_process,
    process_cost,
    rotation_between,
)
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

PRIOR = MotionPrior()


def wild_knots(seed: int, *, count: int = 4, step_s: float = 0.2) -> States:
    """States of a robot that tumbles: neighbours turn by up to two radians, unlike what their velocities say."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.uniform(-1.2, 1.2, (count, 3))).as_matrix()
    turns[0] = Rotation.random(random_state=seed).as_matrix()
    rotation = [turns[0]]
    for turn in turns[1:]:
        rotation.append(rotation[-1] @ turn)
    time_s = 100.0 + np.cumsum(rng.uniform(0.2, 1.8, count) * step_s)
    return States(time_s, rng.normal(size=(count, 3)), np.array(rotation), *rng.normal(size=(4, count, 3)))


def spinning(step_s: float, *, count: int = 2) -> States:
    """Exact states under a constant angular acceleration across the angular velocity."""
    fine = 2000
    rate, acceleration = np.array([0.8, -0.3, 0.5]), np.array([-0.5, 0.9, 0.4])
    dt_s = step_s / fine
    rotation, kept = np.eye(3), [np.eye(3)]
    for k in range((count - 1) * fine):
        rotation = rotation @ exp_so3((rate + acceleration * (k + 0.5) * dt_s) * dt_s)
        if (k + 1) % fine == 0:
            kept.append(rotation)
    time_s = np.arange(count, dtype=np.float64) * step_s
    zero = np.zeros((count, 3))
    rates = rate + time_s[:, None] * acceleration
    return States(time_s, zero, np.array(kept), zero, rates, zero, np.tile(acceleration, (count, 1)))


def numerical_jacobian(knots: States, steps: ProcessFactors, row: int) -> FloatArray:
    """Jacobian of all residuals by the error of one knot, (K - 1, 18, 18), by central differences."""
    step = 1e-6
    columns = []
    for part in range(STATE_DIM):
        error = np.zeros((len(knots), STATE_DIM))
        error[row, part] = step
        forth, back = (linearise_process(knots.retract(sign * error), steps).residuals for sign in (1, -1))
        columns.append((forth - back) / (2 * step))
    return np.stack(columns, axis=-1)


@settings(derandomize=True, max_examples=30)
@given(st.integers(0, 10**6))
def test_local_coordinates_invert_retract(seed: int) -> None:
    """The local coordinates of retracted states are the added errors."""
    knots = wild_knots(seed)
    error = np.random.default_rng(seed).uniform(-1.5, 1.5, (len(knots), STATE_DIM))
    np.testing.assert_allclose(knots.retract(error).local_coordinates_about(knots), error, atol=1e-12)


def test_concatenated_states_are_the_whole() -> None:
    """States split and concatenated are unchanged."""
    knots = wild_knots(1)
    again = concatenate_states([knots.select(slice(0, 1)), knots.select(slice(1, None))])
    for name in States.__slots__:
        np.testing.assert_array_equal(getattr(again, name), getattr(knots, name))


@settings(derandomize=True, max_examples=30)
@given(st.integers(0, 10**6))
@pytest.mark.slow
def test_process_jacobians_are_exact(seed: int) -> None:
    """For random states, by both knots, they equal central differences."""
    knots = wild_knots(seed)
    steps = ProcessFactors.of(knots.time_s, PRIOR)
    by_earlier, by_later = dense_jacobians(linearise_process(knots, steps), steps)
    for row in range(len(knots)):
        by_row = numerical_jacobian(knots, steps, row)
        if row < len(knots) - 1:
            np.testing.assert_allclose(by_earlier[row], by_row[row], atol=2e-8)
        if row > 0:
            np.testing.assert_allclose(by_later[row - 1], by_row[row - 1], atol=2e-8)


def dense_jacobians(found: LinearisedProcess, steps: ProcessFactors) -> tuple[FloatArray, FloatArray]:
    """Jacobians of all residuals by the errors of both knots, (N, 18, 18) each."""
    by_earlier, by_later = -axes_to_state(steps.phi), np.tile(np.eye(STATE_DIM), (len(steps.phi), 1, 1))
    by_earlier[:, 3:6, 3:6] = found.rotation_by_earlier[:, :, :3]
    by_earlier[:, 3:6, 9:12] += found.rotation_by_earlier[:, :, 3:]
    by_later[:, 3:6, 3:6] = found.rotation_by_later[:, :, :3]
    by_later[:, 3:6, 9:12] = found.rotation_by_later[:, :, 3:]
    return by_earlier, by_later


@settings(derandomize=True, max_examples=20)
@given(st.integers(0, 10**6))
def test_process_factors_in_the_normal_equations(seed: int) -> None:
    """The added terms equal those of dense Jacobians, information and residuals."""
    knots = wild_knots(seed)
    steps = ProcessFactors.of(knots.time_s, PRIOR)
    found = linearise_process(knots, steps)
    count, weights = len(knots), axes_to_state(steps.information)
    jacobian = np.zeros((count - 1, STATE_DIM, count * STATE_DIM))
    for row, (earlier, later) in enumerate(zip(*dense_jacobians(found, steps), strict=True)):
        jacobian[row, :, row * STATE_DIM : (row + 2) * STATE_DIM] = np.concatenate([earlier, later], axis=1)
    expected = np.einsum("nia,nij,njb->ab", jacobian, weights, jacobian)
    diagonal, off_diagonal = (
        np.zeros((count, STATE_DIM, STATE_DIM)),
        np.zeros((count - 1, STATE_DIM, STATE_DIM)),
    )
    gradient = np.zeros((count, STATE_DIM))
    cost = add_process_factors(found, steps, diagonal, off_diagonal, gradient)
    for row in range(count):
        here, following = (slice(k * STATE_DIM, (k + 1) * STATE_DIM) for k in (row, row + 1))
        np.testing.assert_allclose(
            diagonal[row], expected[here, here], rtol=1e-9, atol=1e-12 * expected.max()
        )
        if row < count - 1:
            np.testing.assert_allclose(
                off_diagonal[row], expected[here, following], rtol=1e-9, atol=1e-12 * expected.max()
            )
    pulled = np.einsum("nij,nj->ni", weights, found.residuals)
    np.testing.assert_allclose(
        gradient.ravel(), np.einsum("nia,ni->a", jacobian, pulled), rtol=1e-7, atol=1e-6
    )
    assert cost == pytest.approx(float(np.vdot(pulled, found.residuals)))


@settings(derandomize=True, max_examples=20)
@given(st.integers(0, 10**6), st.booleans())
def test_cost_alone_is_that_of_the_normal_equations(seed: int, resting: bool) -> None:  # noqa: FBT001
    """With and without rest."""
    knots = wild_knots(seed)
    rest = np.random.default_rng(seed).uniform(0.0, 1e4, (len(knots) - 1, 6)) if resting else None
    steps = ProcessFactors.of(knots.time_s, PRIOR, rest=rest)
    count = len(knots)
    matrices = np.zeros((count, STATE_DIM, STATE_DIM)), np.zeros((count - 1, STATE_DIM, STATE_DIM))
    cost = add_process_factors(
        linearise_process(knots, steps), steps, *matrices, np.zeros((count, STATE_DIM))
    )
    assert process_cost(knots, steps) == pytest.approx(cost, rel=1e-9)


def test_expected_step_has_no_residual() -> None:
    """Without noise velocities persist and accelerations decay."""
    dt_s = 0.7
    tau = PRIOR.acceleration_correlation_time_s
    start, speed, push = np.array([[1.0, 2, 3]]), np.array([[0.5, -1, 0.2]]), np.array([[0.3, 0.1, -0.2]])
    dying = np.exp(-dt_s / tau)
    lost = tau * (1 - dying)
    still = np.zeros((2, 3))
    knots = States(
        np.array([0.0, dt_s]),
        np.concatenate([start, start + dt_s * speed + tau * (dt_s - lost) * push]),
        np.broadcast_to(np.eye(3), (2, 3, 3)),
        np.concatenate([speed, speed + lost * push]),
        still,
        np.concatenate([push, dying * push]),
        still,
    )
    np.testing.assert_allclose(
        linearise_process(knots, ProcessFactors.of(knots.time_s, PRIOR)).residuals, 0.0, atol=1e-14
    )


def test_magnus_term_is_of_fourth_order() -> None:
    """Under a constant angular acceleration the residual falls with the fifth power of the step, without the term with the third."""
    steady = replace(PRIOR, angular_acceleration_correlation_time_s=1e4)
    left, uncorrected = [], []
    for step_s in (0.4, 0.2):
        knots = spinning(step_s)
        residuals = linearise_process(knots, ProcessFactors.of(knots.time_s, steady)).residuals[0, 3:6]
        left.append(np.linalg.norm(residuals))
        wander = step_s**2 / 12 * np.cross(knots.angular_velocity[0], knots.angular_velocity[1])
        uncorrected.append(np.linalg.norm(residuals + wander))
    assert left[0] < 2e-4
    assert left[0] / left[1] == pytest.approx(32, rel=0.15)
    assert uncorrected[0] / uncorrected[1] == pytest.approx(8, rel=0.15)
    assert uncorrected[1] > 30 * left[1]


@pytest.mark.parametrize("turned_rad", [0.0, 0.2, 2.0, 3.1, 3.2, 4.5, 5.9])
def test_rotation_beyond_pi_follows_the_angular_velocity(turned_rad: float) -> None:
    """Up to nearly a whole revolution between two states."""
    axis, dt_s = np.array([0.6, 0.0, 0.8]), 7.0
    zero, rates = np.zeros((2, 3)), np.tile(0.9 * turned_rad / dt_s * axis, (2, 1))
    rotation = np.stack([np.eye(3), exp_so3(turned_rad * axis)])
    knots = States(np.array([0.0, dt_s]), zero, rotation, zero, rates, zero, zero)
    found = rotation_between(knots.select(slice(0, 1)), knots.select(slice(1, 2)))
    np.testing.assert_allclose(found[0], turned_rad * axis, atol=1e-9)


def test_information_per_axis() -> None:
    """Twice the sigma gives a quarter of the information, and axes are uncoupled."""
    time_s = np.array([0.0, 0.3])
    one = ProcessFactors.of(time_s, replace(PRIOR, acceleration_sigma_mps2=(0.1, 0.2, 0.4))).information
    np.testing.assert_allclose(one[:, 1], one[:, 0] / 4)
    np.testing.assert_allclose(one[:, 2], one[:, 0] / 16)
    whole = axes_to_state(one)
    mixed = whole.reshape(1, 3, 6, 3, 6).transpose(0, 2, 4, 1, 3).copy()
    for axis in range(6):
        np.testing.assert_array_equal(mixed[0, axis, axis], one[0, axis])
        mixed[0, axis, axis] = 0.0
    np.testing.assert_array_equal(mixed, 0.0)
