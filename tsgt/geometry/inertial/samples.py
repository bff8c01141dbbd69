"""Samples of an inertial measurement unit (IMU) as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class InertialSamples:
    """N samples in the order of time; each is the mean over the interval that ends at ``end_s``.

    Latency and gyro matrix are applied, biases are not. Intervals do not overlap; where one begins later than the one
    before it ends, samples are missing.
    """

    end_s: NDArray[np.float64]  # (N,) from the time origin of the observations
    duration_s: NDArray[np.float64]  # (N,)
    angular_rate_radps: NDArray[np.float64]  # (N, 3) in the axes of the IMU
    specific_force_mps2: NDArray[np.float64]  # (N, 3) in the axes of the IMU

    @classmethod
    def none(cls) -> InertialSamples:
        """Return no samples."""
        return cls(np.empty(0), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))

    def __len__(self) -> int:
        return len(self.end_s)

    def select(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> InertialSamples:
        """Return the samples of some rows."""
        return InertialSamples(
            self.end_s[rows],
            self.duration_s[rows],
            self.angular_rate_radps[rows],
            self.specific_force_mps2[rows],
        )


def concatenate_samples(parts: Sequence[InertialSamples]) -> InertialSamples:
    """Join samples that follow each other."""
    return InertialSamples(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in InertialSamples.__slots__)
    )
