"""Jacobians by the set-up against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.inertial.imu_calibration import uncalibrated_drive

from tsgt.geometry import FloatArray, exp_so3
from tsgt.geometry.inertial import InertialStates, contiguous
from tsgt.geometry.inertial.factors import linearise_inertial
from tsgt.geometry.inertial.solver import diffuse_inertial_prior
from tsgt.geometry.inertial_calibration.joint_solver import without_tilt
from tsgt.geometry.inertial_calibration.joint_system import (
    JointPoint,
    JointProblem,
    assemble_border,
    assemble_states,
    knots_at_samples,
    measurements_by_setup,
    motion_by_matrices,
    stamp_times,
)
from tsgt.geometry.inertial_calibration.setup import (
    ACCELEROMETER_MATRIX,
    DELAYS,
    GYRO_MATRIX,
    LATENCY,
    SetupPrior,
)
from tsgt.geometry.trajectory.block_tridiagonal import factorise

Example = tuple[JointProblem, JointPoint]
STEP = 1e-5


@pytest.fixture(scope="module")
def example() -> Example:
    """Return a few seconds of a drive at states and a set-up that are somewhat wrong."""
    drive = uncalibrated_drive(4.0)
    rng = np.random.default_rng(0)
    samples = contiguous(drive.samples, drive.imu.noise)
    setup = drive.truth.retract(rng.normal(scale=1e-3, size=drive.truth.dim))
    times_s, knot_index = knots_at_samples(stamp_times(drive.observations, setup), samples)
    count = len(times_s)
    yaw = np.outer(0.1 * times_s, [0.1, 0.2, 1.0])
    states = InertialStates(
        times_s,
        drive.observations.in_world().mean(axis=0) + rng.normal(scale=0.01, size=(count, 3)),
        exp_so3(yaw + rng.normal(scale=0.01, size=(count, 3))),
        rng.normal(size=(count, 3)),
        rng.normal(scale=1e-3, size=(count, 3)),
        rng.normal(scale=1e-2, size=(count, 3)),
        np.empty((count, 0)),
    )
    anchor = without_tilt(diffuse_inertial_prior(states.select(slice(0, 1)), drive.gravity, drive.imu.noise))
    prior = SetupPrior.wide(drive.truth, 0.01)
    problem = JointProblem(drive.observations, samples, drive.imu.noise, knot_index, anchor, prior, 1e-4)
    return problem, JointPoint(states, setup, drive.gravity)


def residuals(
    problem: JointProblem, point: JointPoint, component: int, step: float
) -> tuple[FloatArray, FloatArray]:
    """Residuals of measurements, and whitened ones of the motion between knots, after a step of the set-up."""
    moved = np.zeros(point.setup.dim)
    moved[component] = step
    point = point._replace(setup=point.setup.retract(moved))
    found = assemble_states(problem, point)
    rows = linearise_inertial(point.knots, point.gravity, found.factors)
    return found.states.linearised.residuals_m, rows[:, :, 32]


def test_measurements_by_setup(example: Example) -> None:
    """Mounting, position, latency and delays move the residuals of the prisms."""
    problem, point = example
    found = assemble_states(problem, point)
    jacobian = measurements_by_setup(found.observations, found.states.linearised, point.setup)
    for component in [*range(LATENCY + 1), *range(point.setup.dim)[DELAYS]]:
        after, before = (residuals(problem, point, component, sign * STEP)[0] for sign in (1, -1))
        expected = (after - before) / (2 * STEP)
        np.testing.assert_allclose(jacobian[:, :, component], expected, atol=1e-6, err_msg=str(component))
        assert np.abs(expected).max() > 0.05


def test_motion_by_matrices(example: Example) -> None:
    """Both matrices move the residuals of the preintegrated motion; the covariance, which they move too, is constant."""
    problem, point = example
    found = assemble_states(problem, point)
    jacobian = motion_by_matrices(point.knots, point.setup, found.factors, found.by_matrices)
    matrices = slice(GYRO_MATRIX.start, ACCELEROMETER_MATRIX.stop)
    for row, component in enumerate(range(point.setup.dim)[matrices]):
        expected = np.empty((len(point.knots) - 1, 9))
        for sign in (1, -1):
            moved = np.zeros(point.setup.dim)
            moved[component] = sign * STEP
            shifted = point._replace(setup=point.setup.retract(moved))
            factors = replace(assemble_states(problem, shifted).factors, whitening=found.factors.whitening)
            rows = linearise_inertial(point.knots, point.gravity, factors)
            expected = rows[:, :, 32] if sign == 1 else (expected - rows[:, :, 32]) / (2 * STEP)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(jacobian[:, :, row], expected, atol=2e-3 * scale, err_msg=str(component))


def test_information_is_not_negative(example: Example) -> None:
    """Blocks of states, border and corner are products of the same rows: their Schur complement has no negative direction."""
    problem, point = example
    found = assemble_states(problem, point)
    border = assemble_border(problem, point, found)
    solved = factorise(found.states.diagonal, found.states.off_diagonal).solve(border.mixed)
    remaining = border.corner - np.einsum("kbs,kbt->st", border.mixed, solved)
    np.testing.assert_allclose(border.corner, border.corner.T, atol=1e-9 * np.abs(border.corner).max())
    scale = np.sqrt(np.diag(border.corner))
    assert np.linalg.eigvalsh(remaining / np.outer(scale, scale)).min() > -1e-9


def test_gradient_is_that_of_the_cost(example: Example) -> None:
    """Half the derivative of the cost, prior included, is the border's gradient, for measurements of unit weight."""
    problem, point = example
    coarse = replace(
        problem, observations=replace(problem.observations, sigmas_m=problem.observations.sigmas_m * 1e4)
    )
    found = assemble_states(coarse, point)
    border = assemble_border(coarse, point, found)
    gradient = border.gradient[2:] + found.deviation[2:] / problem.prior.sigmas
    for component in range(LATENCY + 1):
        moved = np.zeros(point.setup.dim)
        moved[component] = 1e-4
        after, before = (
            assemble_states(coarse, point._replace(setup=point.setup.retract(sign * moved))).cost
            for sign in (1, -1)
        )
        assert gradient[component] == pytest.approx((after - before) / 4e-4, rel=0.02, abs=1e-2), component
