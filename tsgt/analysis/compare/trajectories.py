"""What is compared: the reference poses, and the estimate of another program."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tsgt.estimation import transform_between
from tsgt.geometry import covariance_over_lever_arm

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.model import ReferencePoint


@dataclass(frozen=True, slots=True)
class ReferencePoses:
    """N reference poses of a point of the robot."""

    stamp_ns: NDArray[np.int64]  # (N,) Unix times, strictly increasing
    T_station1_point: FloatArray  # (N, 4, 4); anything where not valid
    covariance: FloatArray | None  # (N, 6, 6) as in PoseBatch; None: unknown
    covariance_common: FloatArray | None  # (N, 6, 6) part of it that all poses share; None: unknown
    valid: NDArray[np.bool_]  # (N,)
    point: ReferencePoint


@dataclass(frozen=True, slots=True)
class Estimate:
    """M poses, or positions, of a sensor on the robot, as another program estimated them."""

    name: str
    stamp_ns: NDArray[np.int64]  # (M,) on the clock of that program, strictly increasing
    position_m: FloatArray  # (M, 3) of the sensor in the estimate's own frame
    orientation_xyzw: FloatArray | None  # (M, 4) unit quaternions of its axes; None: positions only
    covariance: FloatArray | None  # (M, 6, 6) in the estimate's frame, order as in PoseBatch; None: unknown
    source: str = ""  # Where it was read: file, topic, message type
    notes: tuple[str, ...] = ()  # What reading had to do, a sentence each: sorted, duplicates left out


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
