"""Residuals of a fitted trajectory by station and axis, and outliers: see docs/reference/evaluate.md. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial import InertialFit
from tsgt.geometry.trajectory import linearise, nearest_knots

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry import FloatArray
    from tsgt.geometry.batch import TrajectoryFit
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import Measurement

POLAR_AXES = ("range", "horizontal_angle", "zenith_angle")
POINT_AXES = ("x", "y", "z")

MIN_VARIANCE_SHARE = 1e-3  # Of the noise; below, the trajectory follows the measurement exactly


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Normalised residuals of one axis of a station's measurements, in sigmas; NaN without any.

    If motion prior and noise are as assumed, mean and std are 0 and 1, the share beyond 3 sigmas 0.0027 (normal
    distribution).
    """

    mean: float
    std: float
    beyond_3_sigma: float
    n: int

    @classmethod
    def of(cls, normalised: FloatArray) -> ResidualStatistics:
        """Summarise normalised residuals."""
        if not len(normalised):
            return cls(math.nan, math.nan, math.nan, 0)
        return cls(
            mean=float(np.mean(normalised)),
            std=float(np.std(normalised)),
            beyond_3_sigma=float(np.mean(np.abs(normalised) > 3.0)),
            n=len(normalised),
        )


@dataclass(frozen=True, slots=True)
class Outlier:
    """A rejected measurement, such as a reflection or another prism: recorded time on the master's Unix clock, and error.

    ``missed_mm``: distance between measured and fitted position. ``sigmas``: the same in sigmas of the measurement noise.
    """

    station: int
    prism: int
    stamp_ns: int
    missed_mm: float
    sigmas: float


def normalised_residuals(fit: TrajectoryFit | InertialFit) -> FloatArray:
    """Divide residuals by their expected sigma, (M, 3): along the line of sight, horizontally and vertically across it.

    NaN where a residual carries no information. The trajectory follows the measurement, so its variance there is subtracted:
    Q_vv = Q_ll - A Q_xx A^T (Baarda 1968, A testing procedure for use in geodetic networks).
    """
    if isinstance(fit, InertialFit):
        return np.asarray(fit.residuals_m / np.sqrt(fit.residual_variances_m2))
    at = nearest_knots(fit.trajectory.knots.time_s, fit.observations.time_s)
    linearised = linearise(fit.observations, fit.trajectory.knots, at)
    noise = np.diagonal(linearised.covariance(fit.observations), axis1=1, axis2=2)
    jacobian = linearised.jacobian
    own = np.einsum("mij,mjk,mik->mi", jacobian, fit.trajectory.covariance[at], jacobian, optimize=True)
    expected = noise - fit.weights[:, None] * own
    informative = expected > MIN_VARIANCE_SHARE * noise
    return np.where(informative, fit.residuals_m / np.sqrt(np.where(informative, expected, 1.0)), np.nan)


def residual_statistics(
    fit: TrajectoryFit | InertialFit, sources: Sequence[Measurement]
) -> dict[int, dict[str, ResidualStatistics]]:
    """Summarise the normalised residuals by station and measured axis; ``sources``: the measurement of each observation."""
    normalised = normalised_residuals(fit)
    station = np.array([source.station for source in sources])
    statistics: dict[int, dict[str, ResidualStatistics]] = {}
    for number in np.unique(station).tolist():
        statistics[number] = {}
        for polar, names in ((True, POLAR_AXES), (False, POINT_AXES)):
            rows = (station == number) & (fit.observations.polar == polar)
            for axis, name in enumerate(names if rows.any() else ()):
                values = normalised[rows, axis]
                statistics[number][name] = ResidualStatistics.of(values[np.isfinite(values)])
    return statistics


def noise_scales_by_axis(
    observations: Observations, noise_scales: FloatArray, sources: Sequence[Measurement]
) -> dict[int, dict[str, float]]:
    """Factors on the stated noise, (S, 3), by station and measured axis, with the keys of :func:`residual_statistics`."""
    station = np.array([source.station for source in sources])
    factors: dict[int, dict[str, float]] = {}
    for number in np.unique(station).tolist():
        of_station = observations.select(station == number)
        factors[number] = {}
        for polar, names in ((True, POLAR_AXES), (False, POINT_AXES)):
            for row in np.unique(of_station.station[of_station.polar == polar]):
                factors[number] |= zip(names, noise_scales[row].tolist(), strict=True)
    return factors


def outliers(fit: TrajectoryFit | InertialFit, sources: Sequence[Measurement]) -> list[Outlier]:
    """Return the measurements that the fit rejected, the worst first."""
    rows = np.flatnonzero(fit.weights < 1.0)
    return [
        Outlier(
            station=sources[row].station,
            prism=sources[row].prism,
            stamp_ns=sources[row].stamp_ns,
            missed_mm=1e3 * float(np.linalg.norm(fit.residuals_m[row])),
            sigmas=math.sqrt(fit.squared_distances[row]),
        )
        for row in rows[np.argsort(-fit.squared_distances[rows], kind="stable")].tolist()
    ]
