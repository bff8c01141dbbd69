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
SHARED = np.zeros(2)


def state() -> InertialStates:
    """Return one knot."""
    zero = np.zeros((1, 3))
    position, rotation = np.array([[3.0, -2.0, 1.0]]), exp_so3(np.array([[0.1, -0.2, 1.0]]))
    return InertialStates(np.zeros(1), position, rotation, zero, zero, zero, np.empty((1, 0)))


def anchor(point: np.ndarray) -> InertialAnchor:
    """Return a prior with correlated errors and a mean."""
    rng = np.random.default_rng(1)
    square = rng.normal(size=(17, 17))
    mean = rng.normal(scale=1e-3, size=17)
    return InertialAnchor.at_point(state(), SHARED, square @ square.T, mean, point, RATE)


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


def test_small_errors_cost_the_same_about_any_point() -> None:
    """To first order it is the same Gaussian, with the same displacement by the set-up."""
    rng = np.random.default_rng(2)
    origin, about_point = anchor(np.zeros(3)), anchor(POINT)
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
