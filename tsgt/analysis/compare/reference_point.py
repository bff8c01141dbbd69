"""Reference poses of another point of the robot."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tsgt.estimation import transform_between
from tsgt.geometry import covariance_over_lever_arm

if TYPE_CHECKING:
    from tsgt.analysis.compare.trajectories import ReferencePoses
    from tsgt.model import ReferencePoint


def reference_at(reference: ReferencePoses, point: ReferencePoint) -> ReferencePoses:
    """Return the reference poses of another point, with the covariances there."""
    if point == reference.point:
        return reference
    T_own_point = transform_between(reference.point, point)
    arm_m = reference.T_station1_point[:, :3, :3] @ T_own_point[:3, 3]
    covariance, common = (
        None if each is None else covariance_over_lever_arm(each, arm_m)
        for each in (reference.covariance, reference.covariance_common)
    )
    return replace(
        reference,
        T_station1_point=reference.T_station1_point @ T_own_point,
        covariance=covariance,
        covariance_common=common,
        point=point,
    )
