"""Monitor of inconsistent innovations: marks the intervals in which the state is ambiguous. Sans-I/O.

An inconsistent measurement is wrong, or the robot has manoeuvred; later measurements of other prisms decide. After a wrong
measurement was accepted, later good ones look inconsistent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory.gauss_newton import OUTLIER_THRESHOLD

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations

AMBIGUITY_MARGIN_S = 1.5  # Before the first inconsistent measurement: a few of each prism

NOT_BY_CHANCE_NIS = 45.0
"""A station that has moved has at least one larger NIS. Three degrees of freedom exceed 16, the square of ``OUTLIER_THRESHOLD``, once in
900; in a simulated mission rain, whose noise no covariance states, gave 38 (seed 14056 of benchmarks/run.py soak). A tripod moved by
20 mm gave 64 to 125 in five drives where its prism is the only one; one moved by 10 mm gave 49 to 71 with two prisms in three drives
and 22 in a fourth, and 37 in a drive where its prism is the only one (imu_trust, seeds 13 to 16).
"""

OWN_PRISM_M = 0.1
"""A residual beyond it is that of a wrong prism, not of a tripod that was knocked."""


class InnovationMonitor:
    """Tracks innovations: after an inconsistent one the state is ambiguous until two prisms are consistent in succession.

    A station on a wrong prism agrees with itself, and a trajectory that is bent by a wrong measurement may happen to fit the next
    one of a single prism. ``inconsistent_prisms``: whose inconsistent measurements are not resolved yet. ``alone``: as many
    consistent measurements in succession of one prism resolve an ambiguity without other prisms. ``followed_for_s``: longest time
    from the first to the last inconsistent measurement of one prism in the newest ambiguity that the trajectory follows, once it is
    resolved. One that is inconsistent by chance bends the trajectory, so that one of another prism may follow; and several of one
    prism share the error of one prediction, so that one of them, followed or not, must be beyond :data:`NOT_BY_CHANCE_NIS`. The only
    prism of a layout is followed even if all of its inconsistent measurements stay outliers, unless they are of a wrong prism:
    within two seconds biases and tilt let a trajectory move by some centimetres unnoticed. ``lost_after_s``: the same time of the
    ambiguity in which the trajectory was lost, followed or not, until one is resolved again.
    All states in an outage rest on the measurement after it (:meth:`set_outage`): if that one is ambiguous, they are. It may be though
    all is consistent (:meth:`set_unproven`).
    """

    def __init__(self, alone: int | None = None) -> None:
        self._alone = alone
        self._succession = 0
        self._needs_two_prisms = False
        self._consistent_prisms: frozenset[int] = frozenset()  # since the last inconsistent measurement
        self.inconsistent_prisms: frozenset[int] = frozenset()
        self._inconsistent_from_s = np.inf
        # Of the window's measurements: whether they were inconsistent, and whether the trajectory follows them nevertheless
        self._flagged = self._followed = np.empty(0, np.bool_)
        self._time_s, self._prism = np.empty(0), np.empty(0, np.intp)
        # Of the current ambiguity, by prism: first and last followed measurement that has left the window, and largest NIS
        self._spans_s: dict[int, tuple[float, float]] = {}
        self._largest_nis: dict[int, float] = {}
        self._inconsistent_s: dict[int, tuple[float, float]] = {}  # First and last one, followed or not
        self._ambiguous_intervals_s: list[tuple[float, float]] = []
        self._outage_s = (-np.inf, -np.inf)  # The newest one
        self.followed_for_s = self.lost_after_s = 0.0

    @property
    def measured_prisms(self) -> int:
        """Number of prisms with measurements in the window."""
        return len(np.unique(self._prism))

    @property
    def beyond_chance(self) -> bool:
        """Whether a measurement in the current ambiguity is beyond :data:`NOT_BY_CHANCE_NIS`."""
        return any(nis > NOT_BY_CHANCE_NIS for nis in self._largest_nis.values())

    @property
    def ambiguous_from_s(self) -> float:
        """Start of the current ambiguity, infinite while the innovations are consistent."""
        return self._inconsistent_from_s - AMBIGUITY_MARGIN_S if self.inconsistent_prisms else np.inf

    def ambiguous_at(self, time_s: FloatArray, *, margin_s: float = 0.0) -> NDArray[np.bool_]:
        """Whether the state stays ambiguous at times (N,), by the resolved ambiguities, or did shortly before.

        None remains if all flagged measurements are of one prism and still outliers, and the layout has others: then these were
        wrong. Otherwise the trajectory followed the wrong ones, or was bent towards all of them.
        """
        found = np.zeros(len(time_s), np.bool_)
        for from_s, until_s in self._ambiguous_intervals_s:
            found |= (time_s >= from_s) & (time_s <= until_s + margin_s)
        return found

    def reset(self, observations: Observations) -> None:
        """Mark the state as ambiguous while the trajectory of a window is being initialised."""
        self.inconsistent_prisms = frozenset(observations.prism.tolist())
        self._flagged = self._followed = np.zeros(len(observations), np.bool_)
        self._time_s, self._prism = observations.time_s, observations.prism
        self._consistent_prisms = frozenset()
        self._succession = 0
        self._spans_s.clear()
        self.lost_after_s = max(self.lost_after_s, self._longest_s(self._inconsistent_s))
        self._largest_nis.clear()
        self._inconsistent_s.clear()
        self.followed_for_s = 0.0

    def set_start(self, time_s: float, *, needs_two_prisms: bool = False) -> None:
        """Start the ambiguity of an initialised trajectory: after its measurements or, if they prove nothing, before them.

        ``needs_two_prisms``: until two prisms agree, however often one does with itself.
        """
        self._inconsistent_from_s = time_s
        self._needs_two_prisms |= needs_two_prisms

    def set_outage(self, from_s: float, until_s: float) -> None:
        """Note the times of the measurements before and after an outage of all prisms."""
        self._outage_s = (from_s, until_s)

    def set_unproven(self, time_s: float, prisms: frozenset[int], *, needs_two_prisms: bool) -> None:
        """Mark the state as ambiguous from a measurement on that a wrong prism could have given as well.

        ``needs_two_prisms``: until two prisms agree, however often one does with itself. What they say then is not true of an ambiguity
        from before an outage: after it the trajectory is so uncertain that all agrees.
        """
        if not self.inconsistent_prisms:
            self._inconsistent_from_s, self.followed_for_s = self._since(time_s), 0.0
        else:
            self._ambiguous_intervals_s.append((self.ambiguous_from_s, time_s))
        self.inconsistent_prisms |= prisms
        self._consistent_prisms, self._succession = frozenset(), 0
        self._needs_two_prisms = needs_two_prisms

    def select(self, rows: NDArray[np.bool_]) -> None:
        """Drop the other measurements of the window."""
        self._extend(self._spans_s, self._followed & ~rows)
        self._flagged, self._followed = self._flagged[rows], self._followed[rows]
        self._time_s, self._prism = self._time_s[rows], self._prism[rows]

    def discard_before(self, before_s: float) -> None:
        """Drop ambiguous intervals that ended long before a time."""
        self._ambiguous_intervals_s = [
            each for each in self._ambiguous_intervals_s if each[1] + AMBIGUITY_MARGIN_S >= before_s
        ]

    def update(
        self,
        observations: Observations,
        is_new: NDArray[np.bool_],
        new_nis: FloatArray,
        outliers: NDArray[np.bool_],
        residuals_m: FloatArray,
        *,
        certain: NDArray[np.bool_] | None = None,
    ) -> None:
        """Process the N new of the window's M measurements (``is_new``); ``outliers``, (M,), are of the updated trajectory.

        ``new_nis``: (N,) of the new ones. ``residuals_m``: (M, 3) of the updated trajectory. ``certain``: (N,) whether the state was
        certain enough that a linear prediction tells what chance gives; None: it was.
        """
        flagged = np.zeros(len(observations), np.bool_)
        flagged[~is_new] = self._flagged
        # Measurements that arrive together may each pass the gate and yet be mutually inconsistent.
        flagged[is_new] = (new_nis > OUTLIER_THRESHOLD**2) | outliers[is_new]
        self._flagged, self._followed = flagged, flagged & ~outliers
        self._time_s, self._prism = observations.time_s, observations.prism
        if len(observations.layout) == 1:
            self._followed = flagged & (np.linalg.norm(residuals_m, axis=1) < OWN_PRISM_M)
        rows = (
            observations.time_s[is_new].tolist(),
            observations.prism[is_new].tolist(),
            flagged[is_new].tolist(),
            (new_nis if certain is None else np.where(certain, new_nis, 0.0)).tolist(),
        )
        for time_s, prism, is_flagged, nis in zip(*rows, strict=True):
            if not self.inconsistent_prisms:
                self._inconsistent_from_s = self._since(time_s)
            if is_flagged:
                self._largest_nis[prism] = max(nis, self._largest_nis.get(prism, 0.0))
                self.inconsistent_prisms |= {prism}
                self._consistent_prisms = frozenset()
            else:
                self._consistent_prisms |= {prism}
                if len(self._consistent_prisms) > 1:
                    self.inconsistent_prisms, self._needs_two_prisms = frozenset(), False
            self._succession = 0 if is_flagged else self._succession + 1
            enough = np.inf if self._alone is None or self._needs_two_prisms else self._alone
            if self._succession >= enough:
                self.inconsistent_prisms = frozenset()
        # A flagged measurement that is no outlier has bent the trajectory: consistent innovations before it prove nothing.
        followed = frozenset(observations.prism[is_new & flagged & ~outliers].tolist())
        if followed:
            self.inconsistent_prisms |= followed
            self._consistent_prisms = frozenset()
        if self.inconsistent_prisms:
            self._extend(self._inconsistent_s, flagged & is_new)
        else:
            if flagged.any() or self._spans_s:
                self._resolve()
            self._largest_nis.clear()
            self._inconsistent_s.clear()
            self.lost_after_s = 0.0

    def _since(self, time_s: float) -> float:
        """Return the time of a measurement or, if an outage has ended shortly before, of the one before that."""
        from_s, until_s = self._outage_s
        return from_s if until_s <= time_s < until_s + AMBIGUITY_MARGIN_S else time_s

    def _resolve(self) -> None:
        """Record the interval of an ambiguity that has just ended, unless its flagged measurements were rejected."""
        flagged = self._flagged
        single_prism = len(np.unique(self._prism[flagged])) == 1
        if self._followed.any() or (flagged.any() and not single_prism):
            times_s = self._time_s[flagged]
            from_s = self._since(float(times_s[0])) - AMBIGUITY_MARGIN_S
            self._ambiguous_intervals_s.append((from_s, float(times_s[-1])))
            self._extend(self._spans_s, self._followed)
        self.followed_for_s = self._longest_s(self._spans_s)
        self._flagged = self._followed = np.zeros_like(flagged)
        self._spans_s.clear()

    def _extend(self, spans_s: dict[int, tuple[float, float]], rows: NDArray[np.bool_]) -> None:
        for prism, time_s in zip(self._prism[rows].tolist(), self._time_s[rows].tolist(), strict=True):
            first_s, last_s = spans_s.get(prism, (time_s, time_s))
            spans_s[prism] = min(first_s, time_s), max(last_s, time_s)

    def _longest_s(self, spans_s: dict[int, tuple[float, float]]) -> float:
        """Return the longest span of a prism one of whose measurements is beyond chance."""
        return max(
            (
                last_s - first_s
                for prism, (first_s, last_s) in spans_s.items()
                if self._largest_nis.get(prism, 0.0) > NOT_BY_CHANCE_NIS
            ),
            default=0.0,
        )
