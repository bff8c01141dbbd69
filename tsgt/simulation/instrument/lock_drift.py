"""Drift of a simulated lock: off the prism before it is lost, and settling after it is found again.

A branch that covers part of the prism, or a robot that turns it away, shifts the spot that the tracker follows. So the last
measurements before a loss and the first ones after it are wrong across the line of sight, and their status does not say so.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import numpy as np

    from tsgt.config import InstrumentModelConfig
    from tsgt.simulation.instrument.visibility import PrismVisibility

DRIFT_S: Final = 1.0
"""Duration of the drift before a loss."""

SETTLING_S: Final = 0.3
"""Time constant of the error after a reacquisition; an assumption."""


class LockDrift:
    """Drift of one instrument's lock, in a random direction at each loss and reacquisition."""

    def __init__(self, model: InstrumentModelConfig, generator: np.random.Generator) -> None:
        self._rate_mps = model.lock_drift_mmps / 1e3
        self._error_m = model.relock_error_mm / 1e3
        self._rng = generator
        self._directions: dict[float, float] = {}  # By the time of the loss or reacquisition

    def offset_m(
        self, visibility: PrismVisibility, now_s: float, locked_s: float | None
    ) -> tuple[float, float]:
        """Return the offset of the line of sight from the prism in m, to the right and downwards.

        ``locked_s``: when the prism was locked on again; None: not since the start.
        """
        right = down = 0.0
        if self._rate_mps > 0:
            lost_s = visibility.first_lost(now_s, now_s + DRIFT_S)
            if lost_s is not None:
                x, y = self._direction(lost_s)
                size_m = self._rate_mps * (DRIFT_S - (lost_s - now_s))
                right, down = right + size_m * x, down + size_m * y
        if self._error_m > 0 and locked_s is not None:
            x, y = self._direction(locked_s)
            size_m = self._error_m * math.exp(-(now_s - locked_s) / SETTLING_S)
            right, down = right + size_m * x, down + size_m * y
        return right, down

    def _direction(self, event_s: float) -> tuple[float, float]:
        angle = self._directions.get(event_s)
        if angle is None:
            angle = self._directions[event_s] = float(self._rng.uniform(0.0, math.tau))
        return math.cos(angle), math.sin(angle)
