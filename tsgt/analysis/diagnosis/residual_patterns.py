"""Patterns in the residuals by station and component: robust moments, autocorrelation, regressors with significance. Sans-I/O."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.geometry import cartesian_to_polar

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import LinearisedSetup

COMPONENTS = ("range", "horizontal_angle", "zenith_angle")
REGRESSORS = ("distance", "zenith_cotangent", "speed", "cos_direction", "sin_direction")
MIN_MEASUREMENTS = 30
SIGNIFICANT_T = 4.0
_TRIMMED = 0.1


@dataclass(frozen=True, slots=True)
class ResidualPattern:
    """Normalised residuals of one component of a station.

    Attributes
    ----------
    median, mad_sigma, trimmed_mean : Robust moments, in sigmas; the mean without the tenth at either end.
    autocorrelation : Of successive residuals; its sigma is about one over the root of ``n``.
    t_values : Of each of :data:`REGRESSORS` in a joint regression.
    """

    n: int
    median: float
    mad_sigma: float
    trimmed_mean: float
    autocorrelation: float
    t_values: dict[str, float]


def residual_patterns(
    linearised: LinearisedSetup, normalised: FloatArray, stations: tuple[int, ...]
) -> dict[int, dict[str, ResidualPattern]]:
    """Patterns by station number and component; those with too few residuals are missing."""
    horizontal, zenith, distance_m = cartesian_to_polar(linearised.observations.points_m)
    values = np.column_stack(
        [distance_m, 1.0 / np.tan(zenith), linearised.speed_mps, np.cos(horizontal), np.sin(horizontal)]
    )
    found: dict[int, dict[str, ResidualPattern]] = {}
    for row, number in enumerate(stations):
        own = linearised.observations.station == row
        found[number] = {
            name: pattern
            for axis, name in enumerate(COMPONENTS)
            if (pattern := _pattern(normalised[own, axis], values[own])) is not None
        }
    return found


def as_numbers(patterns: dict[int, dict[str, ResidualPattern]]) -> dict[str, Any]:
    """Patterns for ``--json``."""
    return {
        str(number): {name: asdict(each) for name, each in components.items()}
        for number, components in patterns.items()
    }


def _pattern(residuals: FloatArray, regressors: FloatArray) -> ResidualPattern | None:
    known = np.isfinite(residuals)
    residuals, regressors = residuals[known], regressors[known]
    if len(residuals) < MIN_MEASUREMENTS:
        return None
    median = float(np.median(residuals))
    mad_sigma = 1.4826 * float(np.median(np.abs(residuals - median)))
    # Single outliers must neither make nor hide a pattern.
    limited = np.clip(residuals, median - 4.0 * mad_sigma, median + 4.0 * mad_sigma)
    ordered = np.sort(residuals)
    cut = int(_TRIMMED * len(ordered))
    centred = limited - limited.mean()
    return ResidualPattern(
        n=len(residuals),
        median=median,
        mad_sigma=mad_sigma,
        trimmed_mean=float(ordered[cut : len(ordered) - cut].mean()),
        autocorrelation=float(centred[1:] @ centred[:-1] / max(float(centred @ centred), 1e-12)),
        t_values=dict(zip(REGRESSORS, _t_values(limited, regressors).tolist(), strict=True)),
    )


def _t_values(residuals: FloatArray, regressors: FloatArray) -> FloatArray:
    """Estimates over their sigmas, with a constant near the regressors; 0 for one that does not vary."""
    spread = regressors.std(axis=0)
    varies = spread > 1e-9
    scaled = (regressors - regressors.mean(axis=0))[:, varies] / spread[varies]
    design = np.column_stack([np.ones(len(scaled)), scaled])
    normal = np.linalg.pinv(design.T @ design)
    estimate = normal @ design.T @ residuals
    error = residuals - design @ estimate
    variance = float(error @ error) / max(len(residuals) - design.shape[1], 1)
    t_values = np.zeros(len(spread))
    t_values[varies] = estimate[1:] / np.sqrt(np.maximum(variance * np.diag(normal)[1:], 1e-30))
    return t_values
