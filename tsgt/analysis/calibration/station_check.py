"""Has a station moved since its targets were measured? The same targets again, seen by the same station, tell.

The targets stand still. Where a station sees them shifted, it has moved itself; how it has moved is the frame fit
of its measurements of now into those of then, as far as the targets hold one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from tsgt.errors import DegenerateGeometryError
from tsgt.geometry import log_so3
from tsgt.geometry.calibration import (
    FALSE_ALARM_RATE,
    MIN_POINTS,
    STATION_LIMITS,
    FrameFit,
    PointPairs,
    fit_frame,
)

if TYPE_CHECKING:
    from tsgt.geometry.calibration import PointName, PointSet

FEWEST_FOR_HEADING = 2


@dataclass(frozen=True, slots=True)
class StationCheck:
    """What the targets say of a station.

    Attributes
    ----------
    shifts_m
        By target: how far the station now sees it from where it saw it then, in m.
    moved_m
        How far the station has moved, in m. From one target it is that target's shift: a turn of the station and a
        movement across the line of sight cannot be told apart there.
    moved_sigma_m
        One sigma of ``moved_m`` along the movement, in m, from the noise of the instrument.
    turned_rad
        By how much the station has turned, in rad; None from one target.
    levelled
        ``turned_rad`` is the heading alone: the targets do not hold more, and the station is taken as levelled.
    ok
        The shifts are no more than noise, or none is beyond the limit.
    consistent
        One movement of the station explains all shifts. If not, a target has moved or was mistaken for another.
    """

    shifts_m: dict[PointName, float]
    moved_m: float
    moved_sigma_m: float
    turned_rad: float | None
    levelled: bool
    ok: bool
    consistent: bool


def check_station(then: PointSet, now: PointSet, *, limit_m: float = 0.0) -> StationCheck:
    """Compare a station's targets of now with those of then.

    Parameters
    ----------
    then, now
        Targets in the station's frame; those of now are all among those of then, at least one.
    limit_m
        Shifts up to this in m are tolerated even where they are more than noise.

    Returns
    -------
    StationCheck
        The test of the shifts against noise has a false alarm in ten thousand.
    """
    pairs = PointPairs(now, then.select(now.names), levelled=False)
    still = FrameFit(np.eye(3), np.zeros(3), np.zeros((6, 6)))
    shifts_m = np.linalg.norm(still.residuals_m(pairs), axis=1)
    count = len(pairs.names)
    noise_only = still.chi_squared(pairs) <= chdtri(3 * count, FALSE_ALARM_RATE)
    fit, levelled = _fit(pairs)
    if fit is None:
        # The mean shift; for one target it is that target's own.
        moved = still.residuals_m(pairs).mean(axis=0)
        covariance = still.residual_covariances_m2(pairs).mean(axis=0) / count
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
    """Fit as much as the targets hold: all, or position and heading (True), or nothing."""
    for levelled, fewest in ((False, MIN_POINTS), (True, FEWEST_FOR_HEADING)):
        if len(pairs.names) < fewest:
            continue
        try:
            fit = fit_frame(PointPairs(pairs.source, pairs.target, levelled), weighted=True)
        except DegenerateGeometryError:
            continue
        if np.linalg.eigvalsh(fit.covariance[3:, 3:]).max() <= STATION_LIMITS.weak_rad**2:
            return fit, levelled
    return None, False
