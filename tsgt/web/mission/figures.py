"""The figures of the pose, with their limits. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from tsgt.web.frames import worst_sigma
from tsgt.web.mission.stations import rounded
from tsgt.web.mission.verdict import POSE_AGE_LIMIT_S

if TYPE_CHECKING:
    from tsgt.recording import PoseRecord, StatusRecord, ValidityLimits


def figures(
    live: PoseRecord | None,
    smoothed: PoseRecord | None,
    limits: ValidityLimits | None,
    status: StatusRecord | None,
    *,
    share: float | None,
    elapsed_s: float,
) -> dict[str, Any]:
    """Return what the page shows of the newest live and smoothed pose.

    ``share``: of the valid poses in the last minute. ``elapsed_s``: time since the last live pose.
    """
    fresh = live if elapsed_s <= POSE_AGE_LIMIT_S else None
    ages = [each.age_s for each in live.stations if each.age_s is not None] if live is not None else []
    return {
        "live": _sigmas(fresh),
        "smoothed": _sigmas(smoothed),
        "delay_s": smoothed.delay_s if smoothed is not None else None,
        "sigma_limit_mm": None if limits is None else _mm(limits.predicted_position_sigma_m),
        "rotation_limit_deg": None if limits is None else _deg(limits.predicted_rotation_sigma_rad),
        "smoothed_limit_mm": None if limits is None else _mm(limits.position_sigma_m),
        "smoothed_rotation_limit_deg": None if limits is None else _deg(limits.rotation_sigma_rad),
        "residual_mm": None if fresh is None else _mm(fresh.residual_m),
        "residual_limit_mm": None if limits is None else _mm(limits.residual_m),
        "valid_share": None if share is None else math.floor(1000 * share) / 1000,  # 100 %: none is invalid
        "poses": status.poses if status is not None else None,
        "valid_poses": status.valid_poses if status is not None else None,
        "data_age_s": rounded(min(ages) + elapsed_s, 2) if ages else None,
        "oldest_age_s": rounded(max(ages) + elapsed_s, 2) if ages else None,
        "outage_limit_s": None if limits is None else limits.outage_s,
    }


def _sigmas(record: PoseRecord | None) -> dict[str, float | None] | None:
    if record is None or record.covariance is None:
        return None
    return {
        "position_mm": rounded(1e3 * worst_sigma(record.covariance, 0), 1),
        "rotation_deg": rounded(math.degrees(worst_sigma(record.covariance, 3)), 2),
    }


def _mm(length_m: float | None) -> float | None:
    return None if length_m is None else rounded(1e3 * length_m, 1)


def _deg(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else rounded(math.degrees(angle_rad), 2)
