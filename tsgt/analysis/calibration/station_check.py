"""Check whether a station has moved since its targets were measured, by measuring some of them again. Sans-I/O.

The targets are stationary: a shift in the station's frame is a movement of the station. The movement is the fit of the
current measurements to the reference measurements, with as many degrees of freedom as the targets determine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from tsgt.errors import DegenerateGeometryError
from tsgt.geometry import log_so3
from tsgt.geometry.target_calibration import (
    FALSE_ALARM_RATE,
    MIN_POINTS,
    WEAK_STATION_RAD,
    FrameFit,
    PointPairs,
    fit_frame,
)

if TYPE_CHECKING:
    from tsgt.geometry.target_calibration import PointName, PointSet

MIN_TARGETS_FOR_HEADING = 2


@dataclass(frozen=True, slots=True)
class StationCheck:
    """Movement of a station.

    Attributes
    ----------
    shifts_m : By target: distance between its reference position and its current one in the station's frame.
    moved_m
        Distance that the station has moved. With one target it is that target's shift: a rotation of the station and
        a movement across the line of sight cannot be separated.
    moved_sigma_m : One sigma of ``moved_m`` along the movement, from the instrument's noise.
    turned_rad : Rotation angle of the station; None with one target.
    levelled : ``turned_rad`` is the heading only: the targets do not determine tilt, the station is assumed to be levelled.
    ok : The shifts are within noise, or none exceeds the limit.
    consistent
        One rigid movement of the station explains all shifts. False: a target has moved or was confused with another.
    """

    shifts_m: dict[PointName, float]
    moved_m: float
    moved_sigma_m: float
    turned_rad: float | None
    levelled: bool
    ok: bool
    consistent: bool


def check_station(reference: PointSet, current: PointSet, *, limit_m: float = 0.0) -> StationCheck:
    """Compare a station's current measurements of targets (a subset, at least one) with the reference, both in its frame.

    Shifts up to ``limit_m`` are accepted even beyond noise. The chi-square test has a false-alarm probability of 1e-4.
    """
    pairs = PointPairs(current, reference.select(current.names), levelled=False)
    unmoved = FrameFit(np.eye(3), np.zeros(3), np.zeros((6, 6)))
    shifts_m = np.linalg.norm(unmoved.residuals_m(pairs), axis=1)
    count = len(pairs.names)
    noise_only = unmoved.chi_squared(pairs) <= chdtri(3 * count, FALSE_ALARM_RATE)
    fit, levelled = _fit(pairs)
    if fit is None:
        # The mean shift.
        moved = unmoved.residuals_m(pairs).mean(axis=0)
        covariance = unmoved.residual_covariances_m2(pairs).mean(axis=0) / count
        consistent = True
    else:
        moved, covariance = fit.translation_m, fit.covariance[:3, :3]
        solved = PointPairs(pairs.source, pairs.target, levelled)
        consistent = bool(fit.chi_squared(solved) <= chdtri(solved.redundancy, FALSE_ALARM_RATE))
    moved_m = float(np.linalg.norm(moved))
    direction = moved / moved_m if moved_m > 0 else np.array([1.0, 0.0, 0.0])
    return StationCheck(
        shifts_m=dict(zip(pairs.names, shifts_m.tolist(), strict=True)),
        moved_m=moved_m,
        moved_sigma_m=float(np.sqrt(direction @ covariance @ direction)),
        turned_rad=None if fit is None else float(np.linalg.norm(log_so3(fit.rotation))),
        levelled=levelled,
        ok=bool(noise_only or shifts_m.max() <= limit_m),
        consistent=consistent,
    )


def _fit(pairs: PointPairs) -> tuple[FrameFit | None, bool]:
    """Fit all degrees of freedom, or position and heading (True), or none, as the targets determine."""
    for levelled, min_targets in ((False, MIN_POINTS), (True, MIN_TARGETS_FOR_HEADING)):
        if len(pairs.names) < min_targets:
            continue
        try:
            fit = fit_frame(PointPairs(pairs.source, pairs.target, levelled), weighted=True)
        except DegenerateGeometryError:
            continue
        if np.linalg.eigvalsh(fit.covariance[3:, 3:]).max() <= WEAK_STATION_RAD**2:
            return fit, levelled
    return None, False
