"""Factors of a trajectory with an IMU: rows and normal equations against numerical derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest
from harness.inertial.inertial_drive import DEG, GRADES
from scipy.spatial.transform import Rotation

from tsgt.geometry.inertial import InertialSamples, contiguous
from tsgt.geometry.inertial.anchor import InertialAnchor
from tsgt.geometry.inertial.factors import (
    InertialFactors,
    assemble_inertial,
    inertial_costs,
    linearise_inertial,
)
from tsgt.geometry.inertial.odometry import Odometry, WheelSamples
from tsgt.geometry.inertial.states import Gravity, InertialStates, Mounting, concatenate_inertial_states
from tsgt.geometry.trajectory import Observations
from tsgt.model import MotionPrior, OdometryParameters

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import ContiguousSamples
    from tsgt.geometry.inertial.factors import InertialEquations

COUNT = 4
NOISE = GRADES["industrial"]


def example(rng: np.random.Generator) -> tuple[ContiguousSamples, InertialStates, Gravity]:
    """Return samples, states of another motion, and tilted gravity."""
    count = 100
    samples = InertialSamples(
        0.005 * np.arange(1, count + 1, dtype=np.float64),
        np.full(count, 0.005),
        rng.normal(scale=0.8, size=(count, 3)),
        rng.normal([0.0, 0.0, 9.8], 3.0, size=(count, 3)),
    )
    states = InertialStates(
        np.array([0.0, 0.131, 0.262, 0.49]),
        rng.normal([30.0, 20.0, 0.0], size=(COUNT, 3)),
        (
            Rotation.random(random_state=1) * Rotation.from_rotvec(rng.normal(scale=0.2, size=(COUNT, 3)))
        ).as_matrix(),
        rng.normal(size=(COUNT, 3)),
        rng.normal(scale=1e-4, size=(COUNT, 3)),
        rng.normal(scale=1e-2, size=(COUNT, 3)),
        np.empty((COUNT, 0)),
    )
    gravity = Gravity(9.81, 1e-3, np.zeros(2)).with_matrix(7e-3, np.array([0.1, -0.3, 0.95]))
    return contiguous(samples, NOISE), states, gravity.retract(rng.normal(scale=0.02, size=8))


@pytest.mark.parametrize("prior", [None, MotionPrior()], ids=["accelerometer", "gyro_only"])
def test_rows_equal_differences(prior: MotionPrior | None) -> None:
    """Jacobians by both states and by what they share, of whitened residuals of order one to thousands."""
    samples, states, gravity = example(np.random.default_rng(0))
    factors = InertialFactors.of(samples, states, NOISE, gyro_only=prior)
    rows = linearise_inertial(states, gravity, factors)
    scale = np.abs(rows[:, :, :38]).max(axis=2, keepdims=True)

    def residuals(error: FloatArray, shared: FloatArray) -> FloatArray:
        return linearise_inertial(states.retract(error), gravity.retract(shared), factors)[:, :, 38]

    h, zero = 1e-6, np.zeros((COUNT, 15))
    for column in range(15):
        for knot in range(COUNT):
            error = zero.copy()
            error[knot, column] = h
            numerical = (residuals(error, np.zeros(8)) - residuals(-error, np.zeros(8))) / (2 * h)
            for step in range(COUNT - 1):
                expected = rows[step, :, 15 * (knot - step) + column] if knot - step in (0, 1) else 0.0
                np.testing.assert_allclose(
                    numerical[step] / scale[step, :, 0], expected / scale[step, :, 0], atol=2e-6
                )
    for column in range(8):
        shared = h * np.eye(8)[column]
        numerical = (residuals(zero, shared) - residuals(zero, -shared)) / (2 * h)
        np.testing.assert_allclose(
            numerical / scale[:, :, 0], rows[:, :, 30 + column] / scale[:, :, 0], atol=2e-6
        )


class Problem(NamedTuple):
    """Measurements, factors and an anchor of a few knots."""

    observations: Observations
    knot_index: NDArray[np.intp]
    kinematics: tuple[FloatArray, FloatArray]
    factors: InertialFactors
    anchor: InertialAnchor

    @classmethod
    def of(
        cls,
        rng: np.random.Generator,
        samples: ContiguousSamples,
        states: InertialStates,
        factors: InertialFactors,
    ) -> Problem:
        """Draw it; large factors against small measurements would hide the latter in rounding."""
        factors = replace(
            factors, whitening=1e-4 * factors.whitening, walk_information=1e-6 * factors.walk_information
        )
        knot_index = np.array([0, 1, 1, 3])
        layout = rng.normal(size=(3, 3))
        prism = np.array([0, 1, 2, 0])
        world = states.position[knot_index] + np.einsum(
            "nij,nj->ni", states.rotation[knot_index], layout[prism]
        )
        observations = Observations(
            states.time_s[knot_index] + np.array([1e-3, -1e-3, 1e-3, 0.0]),
            np.zeros(4),
            world + rng.normal(scale=0.003, size=(4, 3)),
            np.full((4, 3), 0.01),
            np.ones(4, np.bool_),
            np.zeros(4, np.intp),
            prism,
            np.eye(4)[None],
            layout,
        )
        size = states.dim + 8
        square = rng.normal(size=(size, size))
        anchor = InertialAnchor(
            states.select(slice(0, 1)).retract(rng.normal(scale=0.01, size=(1, states.dim))),
            np.full(8, 0.01),
            square @ square.T,
            rng.normal(scale=0.01, size=size),
            rng.normal(size=3),
            rng.normal(size=3),
        )
        return cls(observations, knot_index, samples.at(states.time_s), factors, anchor)

    def at(self, states: InertialStates, gravity: Gravity) -> InertialEquations:
        """Return the normal equations."""
        return assemble_inertial(
            self.observations, self.knot_index, states, self.kinematics, gravity, self.factors, self.anchor
        )


@pytest.mark.parametrize("prior", [None, MotionPrior()], ids=["accelerometer", "gyro_only"])
def test_gradient_equals_differences_of_the_cost(prior: MotionPrior | None) -> None:
    """The gradient of the normal equations is half that of the cost, measurements and anchor included."""
    rng = np.random.default_rng(2)
    samples, states, gravity = example(rng)
    problem = Problem.of(rng, samples, states, InertialFactors.of(samples, states, NOISE, gyro_only=prior))

    def at(error: FloatArray, shared: FloatArray) -> InertialEquations:
        return problem.at(states.retract(error), gravity.retract(shared))

    zero = np.zeros((COUNT, 15))
    system = at(zero, np.zeros(8))
    h = 1e-6
    numerical = np.empty((COUNT, 15))
    for knot in range(COUNT):
        for column in range(15):
            error = zero.copy()
            error[knot, column] = h
            numerical[knot, column] = (at(error, np.zeros(8)).cost - at(-error, np.zeros(8)).cost) / (4 * h)
    scale = np.sqrt(np.einsum("kii->ki", system.diagonal))
    np.testing.assert_allclose(
        numerical / scale, system.gradient / scale, atol=2e-3 * np.abs(system.gradient / scale).max()
    )
    h = 1e-3
    by_shared = [(at(zero, h * each).cost - at(zero, -h * each).cost) / (4 * h) for each in np.eye(8)]
    np.testing.assert_allclose(by_shared, system.corner_gradient, rtol=2e-3)


@pytest.mark.parametrize("prior", [None, MotionPrior()], ids=["accelerometer", "gyro_only"])
@pytest.mark.parametrize("driven", [False, True], ids=["alone", "odometry"])
def test_costs_are_those_of_the_normal_equations(prior: MotionPrior | None, *, driven: bool) -> None:
    """The costs of several trajectories at once, outliers included, equal those that their normal equations give."""
    rng = np.random.default_rng(3)
    samples, states, gravity = example(rng)
    odometry = None
    if driven:
        states = states.with_wheels()
        speeds = WheelSamples(samples.bounds_s[1:], np.diff(samples.bounds_s), rng.normal(size=len(samples)))
        mounting = Mounting(np.eye(3), np.zeros(3))
        odometry = Odometry.of(speeds, OdometryParameters(), mounting, np.zeros(3))
    factors = InertialFactors.of(samples, states, NOISE, gyro_only=prior, odometry=odometry)
    problem = Problem.of(rng, samples, states, factors)
    scales = (0.0, 0.01, 0.3)
    moved = [states.retract(rng.normal(scale=scale, size=(COUNT, states.dim))) for scale in scales]
    gravities = [gravity.retract(rng.normal(scale=scale, size=8)) for scale in scales]
    found = inertial_costs(
        problem.observations,
        problem.knot_index,
        concatenate_inertial_states(moved),
        gravities,
        problem.kinematics,
        problem.factors,
        problem.anchor,
    )
    expected = [problem.at(*each).cost for each in zip(moved, gravities, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_gravity_is_tilted() -> None:
    """The tilt is the rotation vector from the z axis of station 1 to the vertical."""
    gravity = Gravity(9.81, 1e-3, np.array([2 * DEG, -1 * DEG]))
    expected = Rotation.from_rotvec([2 * DEG, -1 * DEG, 0]).apply([0, 0, -9.81])
    np.testing.assert_allclose(gravity.vector(), expected, atol=1e-12)
