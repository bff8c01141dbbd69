"""Held-out prediction errors in sigmas: whether the trajectory's covariance and the noise explain them. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr, ndtri

from tsgt.geometry.trajectory import linearise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialTrajectory
    from tsgt.geometry.trajectory import Observations, Trajectory

GAP_S, NEAR_S = 0.9, 1.0
GROSS_SHARE, GROSS_SIGMA_M = 0.035, 0.045
"""Gross errors near a loss of lock, with a good status: 3.5 % of the measurements in each of both published segments, 50 and
35 mm by component."""

THRESHOLD_SIGMAS = 3.29  # Exceeded by one in a thousand of the normal distribution, both sides


@dataclass(frozen=True, slots=True)
class NormalisedErrorStatistics:
    """Prediction errors of one component in sigmas: ``rms`` is 1 and ``beyond`` 0.001 where all is as stated."""

    rms: float
    robust: float  # 1.48 times the median of the absolute errors: the rms without tails
    beyond: float  # Share beyond 3.29 sigmas
    n: int

    @classmethod
    def of(cls, normalised: FloatArray) -> NormalisedErrorStatistics:
        """Summarise; NaN without any."""
        if not len(normalised):
            return cls(np.nan, np.nan, np.nan, 0)
        return cls(
            rms=float(np.sqrt(np.mean(normalised**2))),
            robust=1.4826 * float(np.median(np.abs(normalised))),
            beyond=float(np.mean(np.abs(normalised) > THRESHOLD_SIGMAS)),
            n=len(normalised),
        )


def near_loss(time_s: FloatArray, station: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(M,) whether a measurement is within a second of a gap of its station: the lock was lost, or is about to be.

    ``time_s``, (M,), in increasing order. A gap is longer than 0.9 s: at 2.5 Hz, two measurements are missing.
    """
    near = np.zeros(len(time_s), np.bool_)
    for each in np.unique(station):
        rows = np.flatnonzero(station == each)
        own_s = time_s[rows]
        before = np.flatnonzero(np.diff(own_s) > GAP_S)
        starts_s = np.concatenate([own_s[before], [np.inf]])
        ends_s = np.concatenate([[-np.inf], own_s[before + 1]])
        next_loss_s = starts_s[np.searchsorted(starts_s, own_s)]
        last_return_s = ends_s[np.searchsorted(ends_s, own_s, side="right") - 1]
        near[rows] = (next_loss_s - own_s <= NEAR_S) | (own_s - last_return_s <= NEAR_S)
    return near


def normalised_prediction_errors(
    trajectory: Trajectory | InertialTrajectory, test: Observations, near: NDArray[np.bool_] | None = None
) -> FloatArray:
    """Divide prediction errors by their sigma, (N, 3): along the line of sight, horizontally and vertically across it.

    The sigma has two parts: the covariance of the predicted prism, and the noise of the measurement. Near a loss of lock the
    distribution is a mixture with gross errors, and an error is stated as the normal deviate of the same probability.

    Parameters
    ----------
    test : N measurements that the trajectory was not fitted to, their noise scaled.
    near : (N,) of :func:`near_loss`; by default none.
    """
    states, covariance = trajectory.at(test.time_s)
    linearised = linearise(test, states, np.arange(len(test)))
    jacobian = linearised.jacobian[
        :, :, : covariance.shape[2]
    ]  # At the times of the states, the pose alone matters
    expected = np.einsum("mij,mjk,mik->mi", jacobian, covariance, jacobian, optimize=True) + np.diagonal(
        linearised.covariance(test), axis1=1, axis2=2
    )
    normalised: FloatArray = linearised.residuals_m / np.sqrt(expected)
    if near is not None and near.any():
        error_m = np.abs(linearised.residuals_m[near])
        gross_m = np.sqrt(expected[near] + GROSS_SIGMA_M**2)
        beyond = (1.0 - GROSS_SHARE) * ndtr(-np.abs(normalised[near])) + GROSS_SHARE * ndtr(
            -error_m / gross_m
        )
        normalised[near] = -np.sign(normalised[near]) * ndtri(beyond)
    return normalised


def normalised_by_axis(
    normalised: FloatArray, observations: Observations, names: tuple[str, str, str]
) -> dict[int, dict[str, NormalisedErrorStatistics]]:
    """Summarise errors of polar measurements, (N, 3), by row of the stations and measured axis."""
    return {
        int(station): {
            name: NormalisedErrorStatistics.of(normalised[observations.station == station, axis])
            for axis, name in enumerate(names)
        }
        for station in np.unique(observations.station[observations.polar])
    }
