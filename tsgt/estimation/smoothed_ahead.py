"""Smoothed states of the next epochs, computed together. Sans-I/O.

Live, a few epochs pass between two measurements, and the trajectory stays the same. A query costs little more for several
epochs than for one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory import STATE_DIM

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import States, Trajectory

EPOCHS = 4  # Ten measurements a second come for 20 epochs a second at least


class SmoothedAhead:
    """Smoothed states at epochs, which are multiples of a period; the same bits as a query of each alone."""

    def __init__(self, period_ns: int, *, dim: int = STATE_DIM) -> None:
        self._period_ns, self._dim = period_ns, dim
        self._trajectory: Trajectory | None = None
        self._rows: dict[int, int] = {}
        self._found: tuple[States, FloatArray, FloatArray | None] | None = None

    def at(
        self, trajectory: Trajectory, stamps_ns: Sequence[int], origin_ns: int
    ) -> tuple[States, FloatArray, FloatArray | None]:
        """Return states of a trajectory, their covariance, and its part that is common to all; None: unknown."""
        if trajectory is not self._trajectory or any(stamp_ns not in self._rows for stamp_ns in stamps_ns):
            ahead_ns = [each + i * self._period_ns for i in range(EPOCHS) for each in stamps_ns]
            time_s = (np.array(ahead_ns, dtype=np.int64) - origin_ns) / 1e9
            self._trajectory, self._rows = trajectory, {each: row for row, each in enumerate(ahead_ns)}
            self._found = (
                *trajectory.at(time_s, dim=self._dim),
                trajectory.common_at(time_s, dim=self._dim),
            )
        assert self._found is not None  # noqa: S101 (computed above)
        states, covariance, common = self._found
        rows = np.array([self._rows[each] for each in stamps_ns])
        return states.select(rows), covariance[rows], None if common is None else common[rows]
