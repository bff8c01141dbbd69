"""Sensitivity of a trajectory to what is calibrated and not estimated with it: frames, instrument errors, prisms. Sans-I/O.

The set-up's error is the same for all measurements. To first order it displaces the states by ``-H^-1 C``, with the normal
matrix H of the trajectory and its coupling C to the set-up: consider parameters (S. F. Schmidt, "Application of state-space
methods to navigation problems", 1966). Columns are those of a factor of the set-up's covariance, so that the states' common
covariance is the sensitivity times its transpose.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.rigid import FloatArray
from tsgt.geometry.trajectory.gauss_newton import AnchorPrior, nearest_knots
from tsgt.geometry.trajectory.measurement_factors import LinearisedMeasurements, Observations
from tsgt.geometry.trajectory.states import STATE_DIM, States

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.trajectory.block_tridiagonal import BlockCholesky

SetupJacobian = Callable[[Observations, LinearisedMeasurements], FloatArray]
"""(M, 3, r) Jacobian of the residuals by the set-up's errors, in the columns of a factor of their covariance."""


def coupling(
    observations: Observations,
    linearised: LinearisedMeasurements,
    weights: FloatArray,
    knot_index: NDArray[np.intp],
    count: int,
    by_setup: FloatArray,
) -> FloatArray:
    """(K, 18, r) mixed block of the normal equations of K states and of the set-up, from the (M, 3, r) Jacobian by it."""
    information = np.linalg.inv(linearised.covariance(observations)) * weights[:, None, None]
    mixed = np.zeros((count, STATE_DIM, by_setup.shape[2]))
    np.add.at(mixed, knot_index, linearised.jacobian.swapaxes(1, 2) @ (information @ by_setup))
    return mixed


def sensitivity(factor: BlockCholesky, mixed: FloatArray) -> FloatArray:
    """(K, 18, r) displacement of the states by the set-up's errors."""
    return -factor.solve(mixed)


def common_covariance(displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance of the states from the set-up alone: of each, (K, 18, 18), and with the next one, (K - 1, 18, 18)."""
    transposed = displacement.swapaxes(1, 2)
    return displacement @ transposed, displacement[:-1] @ transposed[1:]


class _Solved(NamedTuple):
    """Measurements as they were linearised, and the anchor prior that they were solved with."""

    observations: Observations
    linearised: LinearisedMeasurements
    weights: FloatArray
    anchor: AnchorPrior
    anchor_displacement: FloatArray | None


class WindowSensitivity:
    """The same in a window of knots that moves with time: the anchor prior's mean moves with the set-up, too.

    Computed when it is asked for, not with each measurement.
    """

    def __init__(self, by_setup: SetupJacobian) -> None:
        self._by_setup = by_setup
        self._solved: _Solved | None = None
        self._anchor: FloatArray | None = None  # (18, r) displacement of the anchor's mean; None: diffuse
        self._displacement: FloatArray | None = None

    def reset(self) -> None:
        """Forget the past: the window is initialised without prior knowledge."""
        self._anchor = None

    def record(
        self,
        observations: Observations,
        linearised: LinearisedMeasurements,
        weights: FloatArray,
        anchor: AnchorPrior,
    ) -> None:
        """Take over a solution of the window."""
        self._solved = _Solved(observations, linearised, weights, anchor, self._anchor)
        self._displacement = None

    def marginalise(
        self,
        past: Observations,
        linearised: LinearisedMeasurements,
        weights: FloatArray,
        knot_index: NDArray[np.intp],
        anchor: AnchorPrior,
        factor: BlockCholesky,
    ) -> None:
        """Move the anchor to the last of the knots that are eliminated with ``factor``."""
        self._anchor = self.displacement(past, linearised, weights, knot_index, anchor, factor)[-1]

    def displacement(
        self,
        observations: Observations,
        linearised: LinearisedMeasurements,
        weights: FloatArray,
        knot_index: NDArray[np.intp],
        anchor: AnchorPrior,
        factor: BlockCholesky,
    ) -> FloatArray:
        """(K, 18, r) displacement of knots from the present anchor on, solved with ``factor``."""
        solved = _Solved(observations, linearised, weights, anchor, self._anchor)
        return sensitivity(factor, self._coupling(solved, knot_index, factor))

    def of_window(self, knots: States, factor: BlockCholesky) -> FloatArray:
        """(K, 18, r) displacement of the knots, computed once per solution."""
        if self._displacement is None:
            assert self._solved is not None  # noqa: S101 (only called with a solution)
            knot_index = nearest_knots(knots.time_s, self._solved.observations.time_s)
            self._displacement = sensitivity(factor, self._coupling(self._solved, knot_index, factor))
        return self._displacement

    def _coupling(self, solved: _Solved, knot_index: NDArray[np.intp], factor: BlockCholesky) -> FloatArray:
        by_setup = self._by_setup(solved.observations, solved.linearised)
        count = factor.banded.shape[1] // factor.size
        mixed = coupling(solved.observations, solved.linearised, solved.weights, knot_index, count, by_setup)
        if solved.anchor_displacement is not None:
            mixed[0] -= solved.anchor.information @ solved.anchor_displacement
        return mixed
