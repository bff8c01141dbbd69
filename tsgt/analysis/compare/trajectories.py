"""What is compared: the reference poses, and the estimate of another program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

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
