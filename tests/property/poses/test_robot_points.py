"""Motion of other points of the robot: states, covariances and second-order terms against differences and samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tsgt.geometry import exp_so3, skew
from tsgt.geometry.trajectory import States, state_at_point, with_second_order_terms

deterministic = settings(derandomize=True, max_examples=50)
STEP = 1e-4


def vectors(limit: float) -> st.SearchStrategy[np.ndarray]:
    """3-vectors with coordinates up to the limit."""
    return arrays(np.float64, (3,), elements=st.floats(-limit, limit))


states = st.builds(
    lambda *parts: States(
        np.zeros(1), parts[0][None], exp_so3(parts[1])[None], *(part[None] for part in parts[2:])
    ),
    *map(vectors, (100.0, 3.0, 3.0, 2.0, 2.0, 2.0)),
)
arms = vectors(5.0)
covariances = arrays(np.float64, (1, 18, 18), elements=st.floats(-1.0, 1.0)).map(
    lambda root: root @ np.swapaxes(root, 1, 2)
)
NONE = np.zeros((1, 18, 18))


def propagated(state: States, dt_s: float) -> States:
    """Propagate a robot with constant accelerations; rotations to third order in time."""
    rate, faster = state.angular_velocity, state.angular_acceleration
    turn = rate * dt_s + faster * dt_s**2 / 2 + np.cross(rate, faster) * dt_s**3 / 12
    return States(
        state.time_s + dt_s,
        state.position + state.velocity * dt_s + state.acceleration * dt_s**2 / 2,
        state.rotation @ exp_so3(turn),
        state.velocity + state.acceleration * dt_s,
        rate + faster * dt_s,
        state.acceleration,
        faster,
    )


@deterministic
@given(states, arms)
def test_velocity_and_acceleration_are_derivatives_of_the_position(state: States, arm: np.ndarray) -> None:
    """Central differences of the point's position and velocity."""
    point, before, after = (
        state_at_point(propagated(state, dt_s), NONE, arm)[0] for dt_s in (0.0, -STEP, STEP)
    )
    seen = state.position[0] + state.rotation[0] @ arm
    np.testing.assert_allclose(point.position[0], seen, atol=1e-12)
    np.testing.assert_allclose(point.velocity, (after.position - before.position) / (2 * STEP), atol=1e-5)
    np.testing.assert_allclose(point.acceleration, (after.velocity - before.velocity) / (2 * STEP), atol=1e-5)


@deterministic
@given(states, arms, covariances)
@pytest.mark.slow
def test_covariance_is_propagated_by_the_exact_jacobian(
    state: States, arm: np.ndarray, covariance: np.ndarray
) -> None:
    """Central differences of the point's error by each component of the state's error."""
    point, found = state_at_point(state, covariance, arm)
    by_error = np.empty((6, 18))
    for part in range(18):
        error = np.zeros((1, 18))
        error[0, part] = STEP
        more, less = (state_at_point(state.retract(sign * error), NONE, arm)[0] for sign in (1, -1))
        by_error[:, part] = (more.local_coordinates_about(point) - less.local_coordinates_about(point))[
            0, :6
        ] / (2 * STEP)
    np.testing.assert_allclose(found[0], by_error @ covariance[0] @ by_error.T, atol=1e-5)
    np.testing.assert_array_equal(state_at_point(state, covariance[:, :6, :6], arm)[1], found)


@deterministic
@given(states, arms, covariances)
def test_opposite_lever_arms_round_trip(state: States, arm: np.ndarray, covariance: np.ndarray) -> None:
    """The opposite lever arm reproduces states and covariance."""
    there, between = state_at_point(state, covariance, arm)
    back, found = state_at_point(there, between, -arm)
    np.testing.assert_allclose(back.local_coordinates_about(state), 0.0, atol=1e-12)
    np.testing.assert_allclose(found, covariance[:, :6, :6], atol=1e-10)


def test_second_order_term_of_one_uncertain_rotation() -> None:
    """The mean square displacement towards the line is that of a sample; first-order errors have none."""
    random = np.random.default_rng(0)
    rotation, axis = exp_so3(np.array([0.3, -0.2, 0.5])), np.array([0.0, 0.6, 0.8])
    arm, sigma_rad = np.array([0.4, 0.3, -0.2]), 0.1
    by_turn = np.vstack([-rotation @ skew(arm), np.eye(3)])
    turns = sigma_rad**2 * np.outer(axis, axis) + 1e-10 * np.eye(3)
    covariance = (by_turn @ turns @ by_turn.T)[None]
    to_line = rotation @ (axis * (axis @ arm) - arm)
    to_line /= np.linalg.norm(to_line)
    sample = [
        to_line @ rotation @ (exp_so3(angle * axis) @ arm - arm)
        for angle in random.normal(0, sigma_rad, 20_000)
    ]
    curved, found_sigma_rad = with_second_order_terms(rotation[None], covariance)
    found = curved[0, :3, :3]
    assert found_sigma_rad == pytest.approx(sigma_rad)
    assert to_line @ found @ to_line == pytest.approx(np.mean(np.square(sample)), rel=0.05)
    assert to_line @ covariance[0, :3, :3] @ to_line < 1e-3 * np.mean(np.square(sample))


def test_second_order_terms_of_two_uncertain_rotations_add() -> None:
    """With one prism seen two rotations are unobserved; their second-order displacements add."""
    random = np.random.default_rng(0)
    rotation, arm = exp_so3(np.array([0.3, -0.2, 0.5])), np.array([0.0, 0.0, -0.9])
    sigmas_rad = np.array([0.1, 0.08, 0.02])
    by_turn = np.vstack([-rotation @ skew(arm), np.eye(3)])
    covariance = (by_turn @ np.diag(sigmas_rad**2) @ by_turn.T)[None]
    to_point = rotation @ arm / np.linalg.norm(arm)
    turns = random.normal(size=(20_000, 3)) * sigmas_rad
    sample = (rotation @ (exp_so3(turns) @ arm - arm).T).T @ to_point
    found = with_second_order_terms(rotation[None], covariance)[0][0, :3, :3]
    assert to_point @ found @ to_point == pytest.approx(np.mean(np.square(sample)), rel=0.05)
