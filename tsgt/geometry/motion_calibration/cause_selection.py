"""Which errors of the set-up the measurements show: Bayesian model selection over few, named causes. Sans-I/O.

Each hypothesis gives some errors a wide prior in addition to the nominal one of all. Hypotheses are added, exchanged and
removed one at a time while the evidence grows. The refinement (:mod:`.refinement`) asks another question of the same
information: which directions to free so that the set-up fits. It takes no drifts, which a set-up cannot have, and wider priors,
so that gross errors are corrected in full; here priors are of the size of faults that have a name, which tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.motion_calibration.setup_errors import DRIFT, FRAME
from tsgt.geometry.motion_calibration.setup_prior import factor_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry.motion_calibration.information import Information
    from tsgt.geometry.motion_calibration.setup_errors import SetupErrors
    from tsgt.geometry.rigid import FloatArray

EVIDENCE_THRESHOLD = (
    7.0  # Log Bayes factor beyond which a cause counts: 1100 to 1, as about 40 causes are tested
)
AMBIGUITY = 3.0  # Alternatives whose log Bayes factor is lower by less are named as well (20 to 1)
MAX_CAUSES = 6

_SHIFT_M, _TURN_RAD, _DRIFT_M, _DRIFT_RAD = 0.010, 3e-4, 0.010, 2e-4


class SetupCause(StrEnum):
    """Kind of a set-up error."""

    TURNED = "turned_tripod"
    TILTED = "tilted_tripod"
    SHIFTED = "shifted_tripod"
    FRAME = "frame"
    SINKING = "sinking_tripod"
    TURNING = "turning_tripod"
    DRIFT = "drifting_tripod"
    LATENCY = "latency"
    VERTICAL_INDEX = "vertical_index"
    COLLIMATION = "collimation"
    RANGE_CONSTANT = "range_constant"
    RANGE_SCALE = "range_scale"
    PRISM = "prism"


# Components, wide sigma of each, log prior odds against the likeliest cause.
_OF_STATION: dict[SetupCause, tuple[tuple[str, ...], tuple[float, ...], float]] = {
    SetupCause.TURNED: (("rotation_z",), (_TURN_RAD,), 0.0),
    SetupCause.TILTED: (("rotation_x", "rotation_y"), (_TURN_RAD,) * 2, -1.0),
    SetupCause.SHIFTED: (FRAME[:3], (_SHIFT_M,) * 3, -1.0),
    SetupCause.FRAME: (FRAME, (_SHIFT_M,) * 3 + (_TURN_RAD,) * 3, 0.0),
    SetupCause.SINKING: (("drift_z",), (_DRIFT_M,), 0.0),
    SetupCause.TURNING: (("drift_rotation_z",), (_DRIFT_RAD,), 0.0),
    SetupCause.DRIFT: (DRIFT, (_DRIFT_M,) * 3 + (_DRIFT_RAD,) * 3, -1.0),
    SetupCause.LATENCY: (("latency",), (0.010,), 0.0),
    SetupCause.VERTICAL_INDEX: (("vertical_index",), (2e-4,), 0.0),
    SetupCause.COLLIMATION: (("collimation",), (2e-4,), -3.0),
    SetupCause.RANGE_CONSTANT: (("prism_constant",), (0.005,), -1.0),
    SetupCause.RANGE_SCALE: (("range_scale",), (2e-5,), -2.0),
}
_PRISM_M = 0.005


@dataclass(frozen=True, slots=True)
class CauseHypothesis:
    """A possible cause: kind, number of the station or prism, and the errors that it frees, with their wide sigmas."""

    cause: SetupCause
    number: int
    rows: tuple[int, ...]
    sigmas: tuple[float, ...]
    log_odds: float

    @property
    def key(self) -> tuple[SetupCause, int]:
        """What names it."""
        return self.cause, self.number


@dataclass(frozen=True, slots=True, eq=False)
class SelectedCause:
    """A selected hypothesis, its estimate and alternatives.

    Attributes
    ----------
    log_bayes_factor : Of the selected set against that without it.
    estimate, covariance : Of its errors, with all others of the set-up marginalised.
    alternatives : Others that explain the measurements nearly as well in its place, with the log Bayes factor against them.
    """

    hypothesis: CauseHypothesis
    log_bayes_factor: float
    estimate: FloatArray
    covariance: FloatArray
    alternatives: tuple[tuple[CauseHypothesis, float], ...]


def cause_hypotheses(layout: SetupErrors) -> list[CauseHypothesis]:
    """All hypotheses about stations and prisms."""
    found = [
        CauseHypothesis(cause, number, tuple(layout.of_station(number, *names).tolist()), sigmas, log_odds)
        for number in layout.stations
        for cause, (names, sigmas, log_odds) in _OF_STATION.items()
    ]
    found += [
        CauseHypothesis(
            SetupCause.PRISM, number, tuple(layout.of_prism(number).tolist()), (_PRISM_M,) * 3, 0.0
        )
        for number in layout.prisms
    ]
    return found


class CauseSelection:
    """Evidence of sets of hypotheses, each computed once."""

    def __init__(
        self, information: Information, nominal: FloatArray, candidates: Sequence[CauseHypothesis]
    ) -> None:
        self.information = information
        self._nominal = factor_of(nominal)
        self.candidates = tuple(candidates)
        self._known: dict[frozenset[CauseHypothesis], float] = {}

    def prior(self, chosen: frozenset[CauseHypothesis]) -> FloatArray:
        """(G, r) factor of the prior covariance of the errors with these causes."""
        return np.concatenate([self._nominal, *map(self._factor, self._in_order(chosen))], axis=1)

    def _in_order(self, chosen: frozenset[CauseHypothesis]) -> list[CauseHypothesis]:
        """Return causes in the order of the candidates: that of a set, and so the last digits, differ from run to run."""
        return [each for each in self.candidates if each in chosen]

    def _factor(self, hypothesis: CauseHypothesis) -> FloatArray:
        factor = np.zeros((len(self._nominal), len(hypothesis.rows)))
        factor[hypothesis.rows, range(len(hypothesis.rows))] = hypothesis.sigmas
        return factor

    def evidence(self, chosen: frozenset[CauseHypothesis]) -> float:
        """Log evidence of a set of causes, with its prior odds."""
        if chosen not in self._known:
            odds = sum(each.log_odds - EVIDENCE_THRESHOLD for each in self._in_order(chosen))
            self._known[chosen] = self.information.evidence(self.prior(chosen)) + odds
        return self._known[chosen]

    def search(self, start: frozenset[CauseHypothesis] = frozenset()) -> frozenset[CauseHypothesis]:
        """Add, exchange or remove one cause at a time while the evidence grows."""
        chosen = start
        while True:
            best = max(self._neighbours(chosen), key=self.evidence)
            if self.evidence(best) <= self.evidence(chosen) + 1e-6:
                return chosen
            chosen = best

    def _neighbours(self, chosen: frozenset[CauseHypothesis]) -> list[frozenset[CauseHypothesis]]:
        others = [each for each in self.candidates if each not in chosen]
        known = self._in_order(chosen)
        neighbours = [chosen - {each} for each in known]
        neighbours += [chosen - {old} | {new} for old in known for new in others]
        # Two causes that one explained for a while.
        neighbours += [chosen - set(pair) | {new} for pair in combinations(known, 2) for new in others]
        if len(chosen) < MAX_CAUSES:
            neighbours += [chosen | {each} for each in others]
        return neighbours or [chosen]

    def single(self) -> dict[CauseHypothesis, float]:
        """Log Bayes factor of each cause alone against none."""
        none = self.evidence(frozenset())
        return {
            each: self.evidence(frozenset({each})) - none + EVIDENCE_THRESHOLD - each.log_odds
            for each in self.candidates
        }

    def summarise(self, chosen: frozenset[CauseHypothesis]) -> list[SelectedCause]:
        """Estimates and alternatives of the chosen causes, the most evident first."""
        mean, covariance = self.information.posterior(self.prior(chosen))
        found = []
        for each in self._in_order(chosen):
            rows = np.array(each.rows, np.intp)
            rest = chosen - {each}
            gain = self.evidence(chosen) - self.evidence(rest) + EVIDENCE_THRESHOLD - each.log_odds
            alternatives = [
                (other, max(difference, 0.0))
                for other in self.candidates
                if other not in chosen
                and (difference := self.evidence(chosen) - self.evidence(rest | {other})) < AMBIGUITY
                and not set(each.rows) < set(other.rows)  # a wider form of the same
            ]
            alternatives.sort(key=lambda item: item[1])
            found.append(
                SelectedCause(each, gain, mean[rows], covariance[np.ix_(rows, rows)], tuple(alternatives))
            )
        return sorted(found, key=lambda each: -each.log_bayes_factor)
