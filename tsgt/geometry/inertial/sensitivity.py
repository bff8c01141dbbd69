"""What the measurements' residuals and the set-up's errors say about a trajectory with an IMU. Sans-I/O.

The set-up's error displaces the states by ``-H^-1 C`` as without an IMU (``geometry.trajectory.sensitivity``); the tilt of
gravity, which borders H, takes part of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial.factors import by_inertial_states
from tsgt.geometry.inertial.states import INERTIAL_STATE_DIM

if TYPE_CHECKING:
    from tsgt.geometry.inertial.solver import InertialSolution
    from tsgt.geometry.inertial.states import Mounting
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations, SetupJacobian

MIN_VARIANCE_SHARE = 1e-3  # Of the noise; below, the trajectory follows the measurement exactly


def setup_displacement(
    solution: InertialSolution,
    observations: Observations,
    mounting: Mounting,
    setup_jacobian: SetupJacobian,
) -> FloatArray:
    """(K, 15, r) displacement of the states by the set-up's errors, in the columns of a factor of their covariance.

    ``observations``: that were solved, with the layout in the axes of the IMU.
    """
    linearised = solution.linearised
    # Prisms are uncertain along the axes of the robot.
    of_robot = replace(linearised, rotation=linearised.rotation @ mounting.rotation.T)
    by_setup = setup_jacobian(observations, of_robot)
    jacobian = _jacobian(solution)
    information = np.linalg.inv(linearised.covariance(observations)) * solution.weights[:, None, None]
    mixed = np.zeros((len(solution.knots), INERTIAL_STATE_DIM, by_setup.shape[2]))
    np.add.at(mixed, solution.knot_index, np.swapaxes(jacobian, 1, 2) @ (information @ by_setup))
    factor = solution.factor
    alone = factor.states.solve(mixed)
    shared = factor.shared_covariance @ np.einsum("kbs,kbr->sr", factor.border, alone)
    displaced: FloatArray = -(alone + factor.solved_border @ shared)
    return displaced


def residual_variances(
    solution: InertialSolution, observations: Observations, covariance: FloatArray
) -> FloatArray:
    """(M, 3) expected squares of the residuals; NaN where they carry no information.

    The trajectory follows the measurement, so its variance there, from the (K, 15, 15) covariance of the knots, is subtracted:
    Q_vv = Q_ll - A Q_xx A^T (Baarda 1968, A testing procedure for use in geodetic networks).
    """
    noise = np.diagonal(solution.linearised.covariance(observations), axis1=1, axis2=2)
    jacobian = _jacobian(solution)
    own = np.einsum("mij,mjk,mik->mi", jacobian, covariance[solution.knot_index], jacobian, optimize=True)
    expected = noise - solution.weights[:, None] * own
    return np.where(expected > MIN_VARIANCE_SHARE * noise, expected, np.nan)


def _jacobian(solution: InertialSolution) -> FloatArray:
    """(M, 3, 15) of the residuals by the states."""
    linearised = solution.linearised
    rows = np.concatenate([linearised.jacobian, linearised.residuals_m[:, :, None]], axis=2)
    return by_inertial_states(rows, gyro_only=not solution.factors.with_accelerometer)[
        :, :, :INERTIAL_STATE_DIM
    ]
