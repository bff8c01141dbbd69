"""How well a fitted trajectory and the measurements agree: residuals by station and axis, and which measurements stray.

Pure. docs/reference/evaluate.md says what the figures mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory import linearise, nearest_knots

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import TrajectoryFit
    from tsgt.model import Measurement

POLAR_AXES = ("range", "horizontal_angle", "zenith_angle")
POINT_AXES = ("x", "y", "z")

MIN_STEP_FRACTION = 1e-3
"""Where less than this share of a measurement's variance is left to its residual, the trajectory follows it wherever it
goes, and the residual says nothing."""


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Normalised residuals of one axis of a station's measurements, in sigmas; NaN without any.

    Attributes
    ----------
    mean, std
        0 and 1 where motion and noise are as supposed.
    beyond_3_sigma
        Which share of them is further from 0 than 3; 0.0027 of a normal distribution.
    n
        How many there are.
    """

    mean: float
    std: float
    beyond_3_sigma: float
    n: int

    @classmethod
    def of(cls, normalised: FloatArray) -> ResidualStatistics:
        """Sum normalised residuals up."""
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
    """A measurement that strays too far to be noise: a reflection, another prism, a bad status that slipped through.

    Attributes
    ----------
    station, prism
        Who measured what.
    stamp_ns
        Its time as recorded, on the master's Unix clock.
    missed_mm
        By how much the trajectory misses it.
    sigmas
        The same in sigmas of its noise.
    """

    station: int
    prism: int
    stamp_ns: int
    missed_mm: float
    sigmas: float


def normalised_residuals(fit: TrajectoryFit) -> FloatArray:
    """Residuals over the sigma that they should have; NaN where a residual says nothing.

    A residual is smaller than the noise that makes it, because the trajectory gives way to it: of the noise's variance,
    what the trajectory's own at that place takes up is taken off.

    Returns
    -------
    FloatArray
        (M, 3): along the line of sight, horizontally and vertically across it.
    """
    at = nearest_knots(fit.trajectory.knots.time_s, fit.observations.time_s)
    linearised = linearise(fit.observations, fit.trajectory.knots, at)
    noise = np.diagonal(linearised.covariance(fit.observations), axis1=1, axis2=2)
    jacobian = linearised.jacobian
    own = np.einsum("mij,mjk,mik->mi", jacobian, fit.trajectory.covariance[at], jacobian, optimize=True)
    left = noise - fit.weights[:, None] * own
    told = left > MIN_STEP_FRACTION * noise
    return np.where(told, fit.residuals_m / np.sqrt(np.where(told, left, 1.0)), np.nan)


def residual_statistics(
    fit: TrajectoryFit, sources: Sequence[Measurement]
) -> dict[int, dict[str, ResidualStatistics]]:
    """Sum the normalised residuals up by station and by what it measured.

    Parameters
    ----------
    fit
        The trajectory.
    sources
        The measurement of each of its observations.
    """
    normalised = normalised_residuals(fit)
    station = np.array([source.station for source in sources])
    found: dict[int, dict[str, ResidualStatistics]] = {}
    for number in np.unique(station).tolist():
        found[number] = {}
        for polar, names in ((True, POLAR_AXES), (False, POINT_AXES)):
            rows = (station == number) & (fit.observations.polar == polar)
            for axis, name in enumerate(names if rows.any() else ()):
                values = normalised[rows, axis]
                found[number][name] = ResidualStatistics.of(values[np.isfinite(values)])
    return found


def outliers(fit: TrajectoryFit, sources: Sequence[Measurement]) -> list[Outlier]:
    """Name the measurements that the fit has taken for outliers, the worst first."""
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
