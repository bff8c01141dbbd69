"""Noise of the measurements about the trajectory: by station and component, near the loss of lock, single outliers. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import bdtrc

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import LinearisedSetup
    from tsgt.geometry.trajectory import Observations

GAP_S = 0.9  # A station without measurements for longer has lost its prism
NEAR_GAP_S = 1.0  # Measurements this long before and after are near the gap
MIN_REDUNDANCY = 10.0  # Of a station's measurements, for their noise to be estimated
MIN_SHARE = 0.1  # Redundancy of a measurement below which its residual says nothing

LARGE = 3.5  # Sigmas beyond which a component is large: 0.05 % of normally distributed ones
_LARGE_SHARE = 2e-3  # Of measurements beyond it that is usual, with some margin
MIN_GAPS = 3  # Different gaps near which measurements must be wrong for a verdict: it rests on no single one
MIN_LOSS_SHARE = 0.15  # Of all gaps
_SIGNIFICANCE = 1e-5
OUTLIER = 7.0  # Sigmas beyond which a measurement is a gross error
_MIN_OUTLIER_M = 0.03  # Smaller ones are tails of the noise
_OUTLIER_WEIGHT = 0.5  # Largest weight of a gross error in the fit
_SIGMA_PER_MAD = 1.4826  # Of a normal distribution
_MIN_ROBUST = 0.7  # A component that the motion absorbs must not make everything else significant


@dataclass(frozen=True, slots=True)
class LockLoss:
    """Measurements near gaps that are off: gaps with any, all gaps, and their error (rms of the large ones, and largest)."""

    gaps: int
    all_gaps: int
    measurements: int
    rms_m: float
    max_m: float
    p_value: float


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """Noise by station and component, (S, 3): factors on the stated noise, their sigmas, and robust ones from medians."""

    factors: FloatArray
    sigmas: FloatArray
    robust: FloatArray
    normalised: FloatArray  # (M, 3) residuals in sigmas of the robust noise; NaN where they say nothing


def near_gaps(observations: Observations) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Whether measurements, in the order of time, are near a gap of their station, (M,), and the gap's number (-1: none)."""
    gap = np.full(len(observations), -1, np.intp)
    count = 0
    for station in np.unique(observations.station):
        own = np.flatnonzero(observations.station == station)
        time_s = observations.time_s[own]
        for last in np.flatnonzero(np.diff(time_s) > GAP_S).tolist():
            near = (time_s >= time_s[last] - NEAR_GAP_S) & (time_s <= time_s[last])
            near |= (time_s >= time_s[last + 1]) & (time_s <= time_s[last + 1] + NEAR_GAP_S)
            gap[own[near]] = count
            count += 1
    return gap >= 0, gap


def component_noise(linearised: LinearisedSetup, stations: int) -> tuple[FloatArray, FloatArray]:
    """Factors on the noise with which the segments were solved, (S, 3), and their sigmas; 1 and infinity without data.

    Variance component estimation (W. Foerstner, ZfV 104, 1979): the sum of squared residuals of a group over its redundancy.
    Outliers count with their weights, measurements near gaps do not.
    """
    at_gap, _ = near_gaps(linearised.observations)
    weights = np.where(at_gap, 0.0, linearised.weights)[:, None]
    squared = weights * (linearised.residuals_m / linearised.observations.sigmas_m) ** 2
    factors, sigmas = np.ones((stations, 3)), np.full((stations, 3), np.inf)
    for row in range(stations):
        own = linearised.observations.station == row
        redundancy = (weights[own] * linearised.redundancy[own]).sum(axis=0)
        enough = redundancy > MIN_REDUNDANCY
        factors[row, enough] = np.sqrt(squared[own].sum(axis=0)[enough] / redundancy[enough])
        sigmas[row, enough] = factors[row, enough] / np.sqrt(2.0 * redundancy[enough])
    return factors, sigmas


def estimate_noise(linearised: LinearisedSetup, noise: FloatArray) -> NoiseEstimate:
    """Estimate the noise at segments that were solved with factors ``noise``, (S, 3), which are close to the result."""
    change, sigmas = component_noise(linearised, len(noise))
    redundancy = np.maximum(linearised.redundancy, MIN_SHARE)
    expected = linearised.observations.sigmas_m * np.sqrt(redundancy)
    normalised = np.where(linearised.redundancy > MIN_SHARE, linearised.residuals_m / expected, np.nan)
    robust = change.copy()
    at_gap, _ = near_gaps(linearised.observations)
    for row in range(len(noise)):
        values = normalised[(linearised.observations.station == row) & ~at_gap]
        known = np.isfinite(values).sum(axis=0) >= MIN_REDUNDANCY
        if known.any():
            robust[row, known] = _SIGMA_PER_MAD * np.nanmedian(np.abs(values[:, known]), axis=0)
    return NoiseEstimate(
        noise * change,
        np.where(np.isfinite(sigmas), noise * sigmas, np.inf),
        noise * robust,
        normalised / np.maximum(robust, _MIN_ROBUST)[linearised.observations.station],
    )


def without_lock_losses(observations: Observations, loss: LockLoss) -> Observations:
    """Return observations whose stated noise includes the errors near gaps, across the line of sight."""
    at_gap, _ = near_gaps(observations)
    sigmas_m = observations.sigmas_m.copy()
    sigmas_m[at_gap, 1:] = np.hypot(sigmas_m[at_gap, 1:], loss.rms_m)
    return replace(observations, sigmas_m=sigmas_m)


def lock_losses(linearised: LinearisedSetup, normalised: FloatArray) -> LockLoss | None:
    """Whether measurements near gaps are off more often than chance and the others explain; None if not."""
    at_gap, gap = near_gaps(linearised.observations)
    large = np.nanmax(np.where(np.isfinite(normalised), np.abs(normalised), 0.0), axis=1) > LARGE
    if not at_gap.any():
        return None
    usual = max(_LARGE_SHARE, float(np.mean(large[~at_gap])) if (~at_gap).any() else 0.0)
    rows = np.flatnonzero(at_gap & large)
    gaps, every = len(np.unique(gap[rows])), len(np.unique(gap[at_gap]))
    p_value = float(bdtrc(len(rows) - 1, int(at_gap.sum()), usual)) if len(rows) else 1.0
    if gaps < MIN_GAPS or gaps < MIN_LOSS_SHARE * every or p_value > _SIGNIFICANCE:
        return None
    size_m = np.linalg.norm(deviations_m(linearised)[rows], axis=1)
    return LockLoss(gaps, every, len(rows), float(np.sqrt(np.mean(size_m**2))), float(size_m.max()), p_value)


def single_outliers(linearised: LinearisedSetup, normalised: FloatArray) -> NDArray[np.intp]:
    """Rows of gross errors away from gaps."""
    at_gap, _ = near_gaps(linearised.observations)
    size = np.nanmax(np.where(np.isfinite(normalised), np.abs(normalised), 0.0), axis=1)
    large = np.linalg.norm(deviations_m(linearised), axis=1) > _MIN_OUTLIER_M
    return np.flatnonzero(~at_gap & (size > OUTLIER) & large & (linearised.weights < _OUTLIER_WEIGHT))


def deviations_m(linearised: LinearisedSetup) -> FloatArray:
    """(M, 3) distance of each measurement from what the others predict: residuals over redundancies."""
    deviations: FloatArray = linearised.residuals_m / np.clip(linearised.redundancy, MIN_SHARE, 1.0)
    return deviations
