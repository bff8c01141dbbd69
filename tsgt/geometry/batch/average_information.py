"""Curvature of the evidence by the hyperparameters: their average information. Sans-I/O.

The derivative of the measurements' covariance by a hyperparameter, applied to the residuals at the most probable trajectory, is a
working variate. Half the inner products of the variates, trajectory eliminated, are the average of observed and expected
information: never indefinite, and close to the curvature where the model fits (A. R. Gilmour, R. Thompson, B. R. Cullis, "Average
information REML", Biometrics 51, 1995). The same variates tell how the trajectory moves with the hyperparameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dtbtrs

from tsgt.geometry.rigid import matvec
from tsgt.geometry.trajectory.motion_prior import process_noise, transition
from tsgt.geometry.trajectory.states import STATE_DIM, linearise_process

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.geometry.trajectory.states import ProcessFactors

_DIFFERENCE_STEP = 1e-3  # Of a logarithm


@dataclass(frozen=True, slots=True)
class Variates:
    """Working variates of P hyperparameters in the equations of a trajectory of K knots."""

    products: FloatArray  # (P, P) inner products
    right: FloatArray  # (K, 18, P) right-hand sides of the normal equations


@dataclass(frozen=True, slots=True)
class AverageInformation:
    """Average information of hyperparameters, and how the trajectory moves with them."""

    information: FloatArray  # (Q, Q)
    _mixing: FloatArray  # (P, Q) by which the P hyperparameters of the variates change with these
    _banded: FloatArray  # Cholesky factor of the normal equations
    _eliminated: FloatArray  # (18 K, P) its inverse times the right-hand sides

    @classmethod
    def of(cls, solution: Solution, variates: Sequence[Variates], mixing: FloatArray) -> AverageInformation:
        """Eliminate the trajectory; ``variates``: of P hyperparameters in all, of which (P, Q) ``mixing`` makes Q."""
        banded = solution.factor.banded
        right = np.empty((len(mixing), banded.shape[1]))
        information = np.zeros((len(mixing), len(mixing)))
        first = 0
        for each in variates:
            own = slice(first, first + len(each.products))
            information[own, own] = each.products
            right[own] = each.right.reshape(banded.shape[1], -1).T
            first = own.stop
        eliminated, _ = dtbtrs(banded, right.T, uplo="L", overwrite_b=True)
        information -= eliminated.T @ eliminated
        return cls(0.5 * mixing.T @ information @ mixing, mixing, banded, eliminated)

    def displacement(self, change: FloatArray) -> FloatArray:
        """(K, 18) to first order, of the states by a change of the hyperparameters, (Q,)."""
        moved, _ = dtbtrs(
            self._banded, self._eliminated @ (self._mixing @ change)[:, None], uplo="L", trans="T"
        )
        return np.asarray(moved).reshape(-1, STATE_DIM)


def measurement_variates(
    solution: Solution, observations: Observations, scaled: NDArray[np.bool_]
) -> Variates:
    """Variates of the logarithms of 3 S factors on the noise, by station and component, and of one on all time sigmas.

    ``scaled``: (M,) measurements to whose noise the factors apply.
    """
    linearised, weights = solution.linearised, solution.weights
    information = np.asarray(np.linalg.inv(linearised.covariance(observations)), np.float64)
    normalised = matvec(information, linearised.residuals_m)
    by_time = matvec(linearised.by_point, linearised.velocity_mps) * observations.time_sigma_s[:, None]
    # (M, 3, 4) derivatives of the covariance times the normalised residuals: by the three components, and by the time
    derived = np.zeros((len(observations), 3, 4))
    components = np.arange(3)
    derived[:, components, components] = 2.0 * scaled[:, None] * observations.sigmas_m**2 * normalised
    derived[:, :, 3] = 2.0 * by_time * (by_time * normalised).sum(axis=1)[:, None]
    weighted = weights[:, None, None] * (information @ derived)
    inner = np.swapaxes(derived, 1, 2) @ weighted
    sums = np.swapaxes(linearised.jacobian, 1, 2) @ weighted
    count = 3 * len(observations.frames) + 1
    columns = np.column_stack(
        [3 * observations.station[:, None] + components, np.full(len(observations), count - 1)]
    )
    products = np.bincount(
        (columns[:, :, None] * count + columns[:, None, :]).ravel(), inner.ravel(), count**2
    ).reshape(count, count)
    knots = len(solution.knots)
    rows = solution.knot_index[:, None] * STATE_DIM + np.arange(STATE_DIM)
    flat = rows[:, :, None] * count + columns[:, None, :]
    right = np.bincount(flat.ravel(), sums.ravel(), knots * STATE_DIM * count)
    return Variates(
        products.astype(np.float64), right.astype(np.float64, copy=False).reshape(knots, STATE_DIM, count)
    )


def process_variates(
    solution: Solution,
    step_sigmas: FloatArray,
    times_s: FloatArray,
    *,
    sigma_of_axis: Sequence[int],
    scaled: NDArray[np.bool_],
) -> Variates:
    """Variates of the logarithms of sigmas that axes share, and of the two correlation times.

    Parameters
    ----------
    step_sigmas : (K - 1, 6) acceleration sigmas of the steps.
    times_s : (2,) correlation times, of acceleration and angular acceleration.
    sigma_of_axis : Row of each axis' sigma among the results, before those of the correlation times.
    scaled : (K - 1,) steps whose noise scales with these sigmas.
    """
    process = solution.process
    linearised = linearise_process(solution.knots, process)
    residuals = np.swapaxes(linearised.residuals.reshape(-1, 3, 6), 1, 2)
    normalised = matvec(process.information, residuals)
    count = max(sigma_of_axis) + 1
    derived = np.zeros((len(residuals), 6, 3, count + 2))
    for axis, column in enumerate(sigma_of_axis):
        derived[:, axis, :, column] = 2.0 * np.where(scaled[:, None], residuals[:, axis], 0.0)
    dt_s = np.diff(solution.knots.time_s)[:, None]
    up, down = (times_s * np.exp(sign * _DIFFERENCE_STEP) for sign in (1, -1))
    noise_by_time = (process_noise(dt_s, up) - process_noise(dt_s, down)) / (2 * _DIFFERENCE_STEP)
    phi_by_time = (transition(dt_s, up) - transition(dt_s, down)) / (2 * _DIFFERENCE_STEP)
    for kind, axes in ((0, slice(0, 3)), (1, slice(3, 6))):
        derived[:, axes, :, count + kind] = step_sigmas[:, axes, None] ** 2 * matvec(
            noise_by_time[:, None, kind], normalised[:, axes]
        ) + matvec(phi_by_time[:, None, kind], linearised.earlier[:, axes])
    weighted = process.information @ derived
    products = np.tensordot(derived, weighted, axes=((0, 1, 2), (0, 1, 2)))
    right = _transposed_process(
        weighted, process, linearised.rotation_by_earlier, linearised.rotation_by_later
    )
    # A correlation time also changes how accelerations last: a force on each, besides the noise of the steps.
    for kind, axes in ((0, slice(0, 3)), (1, slice(3, 6))):
        time = count + kind
        force = (phi_by_time[:, None, kind, :, 2] * normalised[:, axes]).sum(axis=2)
        right[:-1, 12 + 3 * kind : 15 + 3 * kind, time] += force
        lasting = _lasting(force, process.phi[:, 3 * kind, 2, 2])
        by_noise = np.einsum("ki,kip->p", lasting[1:], derived[:, axes, 2])
        products[time] += by_noise
        products[:, time] += by_noise
        variances = step_sigmas[:, axes] ** 2 * (1.0 - process.phi[:, axes, 2, 2] ** 2)
        first = step_sigmas[0, axes] * lasting[0]
        products[time, time] += float((lasting[1:] ** 2 * variances).sum() + first @ first)
    return Variates(products, right)


def _lasting(force: FloatArray, decay: FloatArray) -> FloatArray:
    """(K, 3) forces on all later accelerations that one at a knot meets, from those of the steps, (K - 1, 3)."""
    banded = np.ones((2, len(decay) + 1))
    banded[0, 1:] = -decay
    lasting, _ = dtbtrs(banded, np.concatenate([force, np.zeros((1, 3))]), uplo="U")
    return np.asarray(lasting)


def _transposed_process(
    weighted: FloatArray,
    process: ProcessFactors,
    rotation_by_earlier: FloatArray,
    rotation_by_later: FloatArray,
) -> FloatArray:
    """(K, 18, P) transposed Jacobian of the process residuals times (K - 1, 6, 3, P)."""
    steps, _, _, count = weighted.shape
    back = np.swapaxes(process.phi, 2, 3) @ weighted
    right = np.zeros((steps + 1, 3, 6, count))
    right[1:] = np.swapaxes(weighted, 1, 2)
    right[1:, 0, 3:] = 0.0
    # Of the position row of a rotation, the linearised rotation takes the place of the transition.
    back[:, 3:, 0] -= weighted[:, 3:, 0]
    right[:-1] -= np.swapaxes(back, 1, 2)
    rotation = weighted[:, 3:, 0]
    for knots, by_knot in ((slice(None, -1), rotation_by_earlier), (slice(1, None), rotation_by_later)):
        # Rotation and angular velocity
        right[knots, :2, 3:] += (np.swapaxes(by_knot, 1, 2) @ rotation).reshape(steps, 2, 3, count)
    return right.reshape(steps + 1, STATE_DIM, count)
