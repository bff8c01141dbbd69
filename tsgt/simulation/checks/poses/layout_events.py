"""The event of the layout monitor, where stations that have moved distort the prisms' triangle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import FrameWatchConfig
from tsgt.model import MIN_PRISMS
from tsgt.simulation.checks.poses.apparent import apparent_poses, has_moves
from tsgt.simulation.checks.poses.expected import measured_epochs

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.simulation.mission import MasterLog, MissionResult

WITHIN_S = 30.0
"""The monitor judges ten seconds of poses; some of them are missing."""

MIN_RATIO = 1.5
"""Misfit of the apparent prisms over the monitor's limit from which three quarters of these poses are far enough above it: noise and
interpolation are added to the misfit, or subtracted.
"""

MIN_MEASURED_SHARE = 0.7
"""Share of the epochs with measurements of all prisms around them."""

_STEP_S = 0.01


def layout_failures(master_log: MasterLog, result: MissionResult) -> Iterator[str]:
    """Yield the first instant by which a distortion of the prisms' triangle should have been reported, and was not."""
    if not has_moves(result, master_log) or len(result.parameters.prisms) < MIN_PRISMS:
        return
    at_s = (measured_epochs(master_log, result) - master_log.unix_at_zero_ns) / 1e9
    if not len(at_s):
        return
    truth, ahead = (result.true_poses(times_s)[:, :3, 3] for times_s in (at_s, at_s + _STEP_S))
    limits = FrameWatchConfig()
    speeds_mps = np.linalg.norm(ahead - truth, axis=1) / _STEP_S
    misfit_m = apparent_poses(result, master_log, at_s).misfit_m
    ratios = 1e3 * misfit_m / (limits.residual_mm + limits.residual_speed_gain_ms * speeds_mps)
    above = np.concatenate([[0], np.cumsum(ratios > MIN_RATIO)])
    min_count = MIN_MEASURED_SHARE * WITHIN_S * 1e9 / result.parameters.pipeline.period_ns
    first = at_s.searchsorted(at_s - WITHIN_S)
    high = above[1:] - above[first] >= 0.75 * np.maximum(np.arange(len(at_s)) + 1 - first, min_count)
    late = at_s[high & ~_reported(master_log, at_s)]
    if len(late):
        yield (
            f"for three quarters of {WITHIN_S:g} s up to {late[0]:.1f} s the stations show a triangle of prisms that is above {MIN_RATIO:g} "
            f"times the limit of the layout monitor, and no event says so"
        )


def _reported(master_log: MasterLog, at_s: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether the alarm was on at instants, or within :data:`WITHIN_S` before them."""
    reported = np.zeros(len(at_s), dtype=np.bool_)
    for event in master_log.events:
        from_s = (event.stamp_ns - master_log.unix_at_zero_ns) / 1e9
        if event.event == "layout_residual_high":
            reported |= at_s >= from_s
        elif event.event == "layout_residual_normal":
            reported &= at_s <= from_s + WITHIN_S
    return reported
