"""Poses of an estimate and of the reference at the same instants, in one frame, of one point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray


@dataclass(frozen=True, slots=True)
class PairedPoses:
    """K poses of the sensor, by the estimate and by the reference, in frame ``station1``.

    Instants at which the reference is invalid, weak or missing are left out, and counted.
    """

    row: NDArray[np.intp]  # (K,) of the estimate
    stamp_ns: NDArray[np.int64]  # (K,) on the reference's clock
    estimated: FloatArray  # (K, 4, 4); of positions alone, the rotation is that of the reference
    reference: FloatArray  # (K, 4, 4)
    reference_covariance: FloatArray | None  # (K, 6, 6) as in PoseBatch
    estimate_covariance: FloatArray | None  # (K, 6, 6) likewise
    has_orientation: bool
    n_estimate: int  # Poses of the estimate
    n_outside: int  # of these before or after the reference
    n_reference_gap: int  # inside, but where the reference is invalid or missing
    n_reference_weak: int  # inside, but where its sigma is above the limit that was asked for
    reference_covariance_common: FloatArray | None = (
        None  # (K, 6, 6) part that all poses share; None: unknown
    )
