"""Measurements that contradict each other: until when it is not known where the robot is, and where it never will be. Pure.

One that is far from what was predicted is wrong, or the robot has done the unexpected. Which it is the next ones tell: those of
another prism that are as predicted. And where a wrong one was believed, the next ones seem wrong beside it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations

AMBIGUITY_MARGIN_S = 1.5
"""So long before a measurement that contradicts, what it may bend is not known either: a few measurements of each prism."""


class InnovationMonitor:
    """Keeps in mind which of the measurements of a window contradicted.

    Attributes
    ----------
    prisms
        Those whose newest measurement contradicts; while there are any, it is not known where the robot goes.
    """

    def __init__(self) -> None:
        self.prisms: frozenset[int] = frozenset()
        self._contradicted_s = np.inf
        self._accused = np.empty(0, np.bool_)
        self._contested_s: list[tuple[float, float]] = []

    @property
    def from_s(self) -> float:
        """From when on it is not known where the robot was, infinite while nothing is doubtful."""
        return self._contradicted_s - AMBIGUITY_MARGIN_S if self.prisms else np.inf

    def ambiguous_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether it will never be known where the robot was at some instants, by the doubts that are settled.

        What contradicted is wrong, or what it contradicted. Where all of it is of one prism, and the trajectory has stayed what
        it was without, it is what is wrong. Otherwise the trajectory went by what came first, or bent to pass by all of it.
        """
        found = np.zeros(len(time_s), np.bool_)
        for from_s, until_s in self._contested_s:
            found |= (time_s >= from_s) & (time_s <= until_s)
        return found

    def begin(self, observations: Observations) -> None:
        """Doubt all of a window, as a trajectory is looked for."""
        self.prisms = frozenset(observations.prism.tolist())
        self._accused = np.zeros(len(observations), np.bool_)

    def begun(self, time_s: float) -> None:
        """Doubt no more than what is after the measurements of that trajectory."""
        self._contradicted_s = time_s

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Let go of the other measurements of the window."""
        self._accused = self._accused[rows]

    def discard_before(self, before_s: float) -> None:
        """Let go of what was before an instant."""
        self._contested_s = [each for each in self._contested_s if each[1] >= before_s]

    def hear(
        self,
        observations: Observations,
        new: NDArray[np.bool_],
        unforeseen: NDArray[np.bool_],
        outlying: NDArray[np.bool_],
    ) -> None:
        """Take note of what new measurements say.

        Parameters
        ----------
        observations
            M of the window, those kept so far and new ones.
        new
            (M,) which are new.
        unforeseen
            (N,) which of these were not as predicted.
        outlying
            (M,) which do not fit the trajectory now.
        """
        accused = np.zeros(len(observations), np.bool_)
        accused[~new] = self._accused
        # As predicted each by itself, those that came together may yet contradict each other.
        accused[new] = unforeseen | outlying[new]
        self._accused = accused
        rows = (observations.time_s[new].tolist(), observations.prism[new].tolist(), accused[new].tolist())
        for time_s, prism, wrong in zip(*rows, strict=True):
            if not self.prisms:
                self._contradicted_s = time_s
            # A station on a wrong prism soon agrees with itself, which says nothing.
            self.prisms = self.prisms | {prism} if wrong else self.prisms & {prism}
        # What was as predicted before these had their say tells nothing of where they have bent it.
        self.prisms |= frozenset(observations.prism[new & accused & ~outlying].tolist())
        if not self.prisms and accused.any():
            self._settle(observations, outlying)

    def _settle(self, observations: Observations, outlying: NDArray[np.bool_]) -> None:
        """Take note of what is contested, if anything is, of what was doubtful until now."""
        accused = self._accused
        one_prism = len(np.unique(observations.prism[accused])) == 1
        if not (one_prism and outlying[accused].all()):
            times_s = observations.time_s[accused]
            self._contested_s.append((float(times_s[0]) - AMBIGUITY_MARGIN_S, float(times_s[-1])))
        self._accused = np.zeros_like(accused)
