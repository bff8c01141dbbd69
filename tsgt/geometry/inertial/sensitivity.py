"""What the measurements' residuals and the set-up's errors say about a trajectory with an IMU. Sans-I/O.

The set-up's error displaces the states by ``-H^-1 C`` as without an IMU (``geometry.trajectory.sensitivity``); the tilt of
gravity and the accelerometer's matrix, which border H, take part of it. In a window that moves with time the mean of the anchor prior moves with the set-up.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.inertial.factors import by_inertial_states
from tsgt.geometry.inertial.states import INERTIAL_STATE_DIM
from tsgt.geometry.rigid import IDENTITY, skew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.anchor import InertialAnchor
    from tsgt.geometry.inertial.bordered import BorderedCholesky
    from tsgt.geometry.inertial.solver import InertialSolution
    from tsgt.geometry.inertial.states import Mounting
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations, SetupJacobian, States

MOUNTING_DIM = 7
"""Errors of the IMU's mounting: position of its origin in the frame of the robot, 3, m; rotation of its axes about those of the robot, 3, rad;
latency of its samples, s.
"""

MIN_VARIANCE_SHARE = 1e-3  # Of the noise; below, the trajectory follows the measurement exactly


class Linearised(NamedTuple):
    """Measurements, with the layout in the axes of the IMU, as they were linearised and solved."""

    observations: Observations
    linearised: LinearisedMeasurements
    weights: FloatArray
    knot_index: NDArray[np.intp]
    anchor: InertialAnchor | None = None  # That depends on the set-up
    anchor_displacement: FloatArray | None = None  # (D + S, r) of its mean


class InertialSensitivity:
    """Displacement of states and of what they share by the set-up's errors, in the columns of a factor of their covariance.

    ``mounting_factor``: (7, r) rows of that factor for the IMU, :data:`MOUNTING_DIM`; None: its mounting is exact.
    """

    def __init__(
        self,
        setup_jacobian: SetupJacobian,
        mounting: Mounting,
        *,
        gyro_only: bool,
        mounting_factor: FloatArray | None = None,
    ) -> None:
        self._by_setup, self._mounting, self._gyro_only = setup_jacobian, mounting, gyro_only
        self._factor = mounting_factor

    def displacement(self, solved: Linearised, factor: BorderedCholesky) -> tuple[FloatArray, FloatArray]:
        """(K, D, r) displacement of K knots, and (S, r) of what they share."""
        observations, linearised, weights, knot_index, anchor, anchor_displacement = solved
        # Prisms are uncertain along the axes of the robot.
        of_robot = replace(linearised, rotation=linearised.rotation @ self._mounting.rotation.T)
        by_setup = self._by_setup(observations, of_robot)
        if self._factor is not None:
            by_setup = by_setup + self._by_mounting(observations, of_robot) @ self._factor
        jacobian = _jacobian(linearised, gyro_only=self._gyro_only)
        information = np.linalg.inv(linearised.covariance(observations)) * weights[:, None, None]
        size = factor.border.shape[1]
        mixed = np.zeros((len(factor.border), size, by_setup.shape[2]))
        np.add.at(
            mixed[:, :INERTIAL_STATE_DIM], knot_index, jacobian.swapaxes(1, 2) @ (information @ by_setup)
        )
        shared = np.zeros((factor.border.shape[2], by_setup.shape[2]))
        if anchor is not None and anchor_displacement is not None:
            by_anchor = anchor.weighted_displacement(anchor_displacement)
            mixed[0] -= by_anchor[:size]
            shared -= by_anchor[size:]
        displaced, shared_displaced = factor.solve(mixed, shared)
        return -displaced, -shared_displaced

    def _by_mounting(self, observations: Observations, of_robot: LinearisedMeasurements) -> FloatArray:
        """(M, 3, 7) Jacobian of the residuals by the errors of the mounting."""
        by_prism = of_robot.by_point @ of_robot.rotation
        arms = observations.layout[observations.prism] @ self._mounting.rotation.T
        by_latency = of_robot.by_point @ of_robot.velocity_mps[:, :, None]
        return np.concatenate([-by_prism, by_prism @ skew(arms), by_latency], axis=2)

    def at_last(self, solved: Linearised, factor: BorderedCholesky) -> FloatArray:
        """(D + S, r) displacement of the last knot and what all share: that of the anchor prior on it."""
        states, shared = self.displacement(solved, factor)
        return np.concatenate([states[-1], shared])


def of_gyro_alone(mounting_factor: FloatArray) -> FloatArray:
    """(7, r) rows for a gyro alone: the states are those of the reference point, wherever it sits."""
    factor = mounting_factor.copy()
    factor[:3] = 0.0
    return factor


def by_mounting(states: States, mounting: Mounting) -> FloatArray:
    """(N, 6, 7) Jacobian of the errors of N poses of the reference point by those of the mounting, where states of the IMU stay."""
    found = np.zeros((len(states), 6, MOUNTING_DIM))
    found[:, 0:3, 0:3] = -states.rotation
    found[:, 0:3, 3:6] = -states.rotation @ skew(mounting.position)
    found[:, 3:6, 3:6] = -IDENTITY
    found[:, 0:3, 6], found[:, 3:6, 6] = states.velocity, states.angular_velocity
    return found


def setup_displacement(
    solution: InertialSolution,
    observations: Observations,
    mounting: Mounting,
    setup_jacobian: SetupJacobian,
    mounting_factor: FloatArray | None = None,
) -> FloatArray:
    """(K, 15, r) displacement of the states of a solution by the set-up's errors.

    ``observations``: that were solved, with the layout in the axes of the IMU. ``mounting_factor``: as of :class:`InertialSensitivity`.
    """
    solved = Linearised(observations, solution.linearised, solution.weights, solution.knot_index)
    gyro_only = not solution.factors.with_accelerometer
    sensitivity = InertialSensitivity(
        setup_jacobian, mounting, gyro_only=gyro_only, mounting_factor=mounting_factor
    )
    return sensitivity.displacement(solved, solution.factor)[0]


def residual_variances(
    solution: InertialSolution, observations: Observations, covariance: FloatArray
) -> FloatArray:
    """(M, 3) expected squares of the residuals; NaN where they carry no information.

    The trajectory follows the measurement, so its variance there, from the (K, 15, 15) covariance of the knots, is subtracted:
    Q_vv = Q_ll - A Q_xx A^T (Baarda 1968, A testing procedure for use in geodetic networks).
    """
    noise = np.diagonal(solution.linearised.covariance(observations), axis1=1, axis2=2)
    jacobian = _jacobian(solution.linearised, gyro_only=not solution.factors.with_accelerometer)
    own = np.einsum("mij,mjk,mik->mi", jacobian, covariance[solution.knot_index], jacobian, optimize=True)
    expected = noise - solution.weights[:, None] * own
    return np.where(expected > MIN_VARIANCE_SHARE * noise, expected, np.nan)


def _jacobian(linearised: LinearisedMeasurements, *, gyro_only: bool) -> FloatArray:
    """(M, 3, 15) of the residuals by the states."""
    rows = np.concatenate([linearised.jacobian, linearised.residuals_m[:, :, None]], axis=2)
    return by_inertial_states(rows, gyro_only=gyro_only)[:, :, :INERTIAL_STATE_DIM]
