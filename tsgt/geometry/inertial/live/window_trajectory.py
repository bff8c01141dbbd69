"""The trajectory of a fixed-lag smoother's window at any time: between knots, and predicted beyond the newest one. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory.states import POSE_DIM, States, concatenate_states

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tsgt.geometry.inertial.query import InertialTrajectory
    from tsgt.geometry.rigid import FloatArray

UNKNOWN_SIGMA = 100.0  # Of positions in m and rotations in rad, of which nothing is known


@dataclass(frozen=True, slots=True)
class WindowTrajectory:
    """The trajectory of a window, and its prediction beyond the newest knot."""

    inside: InertialTrajectory
    predict: Callable[[float, int], tuple[States, FloatArray]]
    predicted_common: Callable[[float, int], FloatArray]

    @property
    def unchanged_until_s(self) -> float:
        """Time up to which states do not depend on samples that arrive later; a single knot has no inside."""
        knots_s = self.inside.knots.time_s
        return float(knots_s[-1]) if len(knots_s) > 1 else -np.inf

    def at(self, time_s: FloatArray, *, dim: int = POSE_DIM) -> tuple[States, FloatArray]:
        """Return states of the reference point at N times, and the (N, 6, 6) covariance of poses.

        Before the first knot, where nothing is known, the pose is that of the knot, with a covariance that says so.
        """
        first_s = self.inside.knots.time_s[0]
        known_s = np.maximum(time_s, first_s)
        beyond = self._beyond(time_s)
        parts = [] if beyond.all() and len(time_s) else [self.inside.at(known_s[~beyond], dim=dim)]
        parts += [self.predict(each, dim) for each in known_s[beyond].tolist()]
        order = _order(beyond)
        states = concatenate_states([each for each, _ in parts]).select(order)
        covariance = np.concatenate([each for _, each in parts])[order]
        covariance[time_s < first_s] += UNKNOWN_SIGMA**2 * np.eye(dim)
        return replace(states, time_s=time_s), covariance

    def common_at(self, time_s: FloatArray, *, dim: int = POSE_DIM) -> FloatArray | None:
        """Return the (N, 6, 6) covariance that the set-up's uncertainty adds; None: unknown."""
        if self.inside.displacement is None:
            return None
        known_s = np.maximum(time_s, self.inside.knots.time_s[0])
        beyond = self._beyond(time_s)
        parts = [] if beyond.all() else [self.inside.common_at(known_s[~beyond], dim=dim)]
        parts += [self.predicted_common(each, dim) for each in known_s[beyond].tolist()]
        known = [each for each in parts if each is not None]
        return np.concatenate(known)[_order(beyond)] if known else np.empty((0, dim, dim))

    def _beyond(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether times are predicted."""
        return time_s > self.unchanged_until_s


def _order(beyond: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Order of time of rows inside, then rows beyond."""
    return np.argsort(np.concatenate([np.flatnonzero(~beyond), np.flatnonzero(beyond)]))
