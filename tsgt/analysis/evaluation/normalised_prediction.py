"""Held-out prediction errors in sigmas: whether the trajectory's covariance and the noise explain them. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation.residuals import POINT_AXES, POLAR_AXES
from tsgt.geometry.trajectory import linearise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialTrajectory
    from tsgt.geometry.trajectory import Observations, Trajectory

THRESHOLD_SIGMAS = 3.29  # Exceeded by one in a thousand of the normal distribution, both sides


@dataclass(frozen=True, slots=True)
class NormalisedErrorStatistics:
    """Prediction errors of one component in sigmas, NaN without any; 1 and a share of 0.001 where all is as stated."""

    rms: float
    robust: float  # 1.48 times the median of the absolute errors: the rms without tails
    beyond_3_29_sigma: float
    n: int

    @classmethod
    def of(cls, normalised: FloatArray) -> NormalisedErrorStatistics:
        """Summarise."""
        if not len(normalised):
            return cls(np.nan, np.nan, np.nan, 0)
        return cls(
            rms=float(np.sqrt(np.mean(normalised**2))),
            robust=1.4826 * float(np.median(np.abs(normalised))),
            beyond_3_29_sigma=float(np.mean(np.abs(normalised) > THRESHOLD_SIGMAS)),
            n=len(normalised),
        )


@dataclass(frozen=True, slots=True)
class NormalisedErrors:
    """Prediction errors of N measurements in sigmas.

    ``sigmas``: (N, 3) by measured component, see :func:`normalised_prediction_errors`; ``rows``: rows of the observations;
    ``polar``: whether the components are range and angles, or coordinates; ``stationary``: in a stationary interval.
    """

    sigmas: FloatArray
    rows: NDArray[np.intp]
    polar: NDArray[np.bool_]
    stationary: NDArray[np.bool_]

    def statistics(self, part: NDArray[np.bool_]) -> dict[str, NormalisedErrorStatistics]:
        """Summarise a part, a mask (N,), by component; empty without any measurement."""
        return {
            name: NormalisedErrorStatistics.of(self.sigmas[of_kind, axis])
            for names, of_kind in ((POLAR_AXES, part & self.polar), (POINT_AXES, part & ~self.polar))
            for axis, name in enumerate(names if of_kind.any() else ())
        }


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
