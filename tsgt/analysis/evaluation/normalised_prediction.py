"""Held-out prediction errors in sigmas: whether the trajectory's covariance and the noise explain them. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory import linearise

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialTrajectory
    from tsgt.geometry.trajectory import Observations, Trajectory

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


def normalised_prediction_errors(
    trajectory: Trajectory | InertialTrajectory, test: Observations
) -> FloatArray:
    """Divide prediction errors by their sigma, (N, 3): along the line of sight, horizontally and vertically across it.

    The sigma has two parts: the covariance of the predicted prism, and the noise of the measurement.

    Parameters
    ----------
    test : N measurements that the trajectory was not fitted to, their noise scaled.
    """
    states, covariance = trajectory.at(test.time_s)
    linearised = linearise(test, states, np.arange(len(test)))
    # Position and rotation only: the states are at the measurements' times.
    jacobian, covariance = linearised.jacobian[:, :, :6], covariance[:, :6, :6]
    expected = np.einsum("mij,mjk,mik->mi", jacobian, covariance, jacobian, optimize=True) + np.diagonal(
        linearised.covariance(test), axis1=1, axis2=2
    )
    normalised: FloatArray = linearised.residuals_m / np.sqrt(expected)
    return normalised
