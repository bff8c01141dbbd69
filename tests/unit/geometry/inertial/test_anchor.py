"""The prior on the first knot, about a point of the robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tsgt.geometry.inertial import InertialStates
from tsgt.geometry.inertial.anchor import InertialAnchor
from tsgt.geometry.rigid import exp_so3

POINT = np.array([0.3, -0.4, 0.6])
RATE = np.array([0.2, 0.1, -0.3])
FALL = np.array([0.01, -0.02, -9.81])
SHARED = np.zeros(2)


def state() -> InertialStates:
    """Return one knot."""
    zero = np.zeros((1, 3))
    position, rotation = np.array([[3.0, -2.0, 1.0]]), exp_so3(np.array([[0.1, -0.2, 1.0]]))
    return InertialStates(np.zeros(1), position, rotation, zero, zero, zero, np.empty((1, 0)))


def anchor(point: np.ndarray, fall: np.ndarray | None = FALL) -> InertialAnchor:
    """Return a prior with correlated errors and a mean."""
    rng = np.random.default_rng(1)
    square = rng.normal(size=(17, 17))
    mean = rng.normal(scale=1e-3, size=17)
    return InertialAnchor.at_point(state(), SHARED, square @ square.T, mean, point, RATE, fall)


@pytest.mark.parametrize("angle_rad", [0.01, 0.3, 2.0])
def test_rotation_about_the_point_does_not_move_it(angle_rad: float) -> None:
    """Whatever the angle: position and velocity that a prism has told say nothing of the heading."""
    first = state()
    turned = first.rotation @ exp_so3(np.array([[0.0, 0.0, angle_rad]]))
    back = (first.rotation - turned)[0]
    moved = replace(
        first,
        rotation=turned,
        position=first.position + back @ POINT,
        velocity=first.velocity + back @ np.cross(RATE, POINT),
    )
    found = anchor(POINT)
    error = found.errors(moved, SHARED[None])[0] + found.mean
    np.testing.assert_allclose(error[[0, 1, 2, 6, 7, 8]], 0.0, atol=1e-12)


@pytest.mark.parametrize("angle_rad", [0.01, 0.3, 2.0])
def test_rotation_that_the_bias_makes_up_for_leaves_gravity_as_it_was(angle_rad: float) -> None:
    """Whatever the angle: what a standing accelerometer has told says nothing of the rotation about the line of two prisms."""
    first = state()
    turned = first.rotation @ exp_so3(np.array([[0.6 * angle_rad, 0.8 * angle_rad, 0.0]]))
    force = -first.rotation[0].T @ FALL  # As it was measured
    moved = replace(first, rotation=turned, bias_or_acceleration=(force + turned[0].T @ FALL)[None])
    found = anchor(POINT)
    error = found.errors(moved, SHARED[None])[0] + found.mean
    np.testing.assert_allclose(error[12:15], 0.0, atol=1e-12)


def test_jacobian_equals_differences() -> None:
    """Also away from the linearisation point, by the errors of all states."""
    found = anchor(POINT)
    rng = np.random.default_rng(3)
    first = state().retract(rng.normal(scale=0.02, size=(1, 15)))
    error = found.errors(first, SHARED[None])[0]
    step = 1e-6
    differences = [
        found.errors(first.retract(step * row[None, :15]), step * row[None, 15:])[0] - error
        for row in np.eye(17)
    ]
    np.testing.assert_allclose(
        found.jacobian(first, error), np.stack(differences, axis=1) / step, rtol=1e-4, atol=2e-4
    )


def test_small_errors_cost_the_same_about_any_point() -> None:
    """To first order it is the same Gaussian, with the same displacement by the set-up."""
    rng = np.random.default_rng(2)
    origin, about_point = anchor(np.zeros(3), None), anchor(POINT)
    error = rng.normal(scale=1e-5, size=17)
    moved = state().retract(error[None, :15])

    def cost(prior: InertialAnchor) -> float:
        found = prior.errors(moved, error[None, 15:])[0]
        return float(found @ prior.information @ found)

    assert cost(about_point) == pytest.approx(cost(origin), rel=1e-6)
    displacement = rng.normal(size=(17, 4))
    np.testing.assert_allclose(
        about_point.weighted_displacement(displacement), origin.weighted_displacement(displacement), rtol=1e-9
    )
    np.testing.assert_allclose(
        origin.weighted_displacement(displacement), origin.information @ displacement, rtol=1e-9, atol=1e-9
    )
