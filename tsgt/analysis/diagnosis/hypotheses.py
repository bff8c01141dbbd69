"""Which errors of the set-up the measurements show: Bayesian model selection over few, named causes. Sans-I/O.

Each hypothesis gives some errors a wide prior in addition to the nominal one of all. The evidence of a set of hypotheses follows in
closed form from the quadratic information (R. E. Kass and A. E. Raftery, Bayes factors, JASA 90, 1995), so that all of them
cost nothing compared with the trajectory. Hypotheses are added, exchanged and removed one at a time while the evidence grows.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.diagnosis.setup_errors import DRIFT, FRAME

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.diagnosis.setup_errors import Information, SetupErrors
    from tsgt.geometry import FloatArray

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
class Hypothesis:
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

    hypothesis: Hypothesis
    log_bayes_factor: float
    estimate: FloatArray
    covariance: FloatArray
    alternatives: tuple[tuple[Hypothesis, float], ...]


def hypotheses(layout: SetupErrors) -> list[Hypothesis]:
    """All hypotheses about stations and prisms."""
    found = [
        Hypothesis(cause, number, tuple(layout.of_station(number, *names).tolist()), sigmas, log_odds)
        for number in layout.stations
        for cause, (names, sigmas, log_odds) in _OF_STATION.items()
    ]
    found += [
        Hypothesis(SetupCause.PRISM, number, tuple(layout.of_prism(number).tolist()), (_PRISM_M,) * 3, 0.0)
        for number in layout.prisms
    ]
    return found


def log_evidence(information: Information, covariance: FloatArray) -> float:
    """Log evidence of errors with this covariance, (G, G), against no errors at all."""
    system = np.eye(len(covariance)) + information.matrix @ covariance
    solved = np.linalg.solve(system, information.vector)
    _, log_determinant = np.linalg.slogdet(system)
    return 0.5 * float(information.vector @ covariance @ solved - log_determinant)


def posterior(information: Information, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean, (G,), and covariance, (G, G), of errors with this prior covariance."""
    system = np.eye(len(covariance)) + information.matrix @ covariance
    found = covariance @ np.linalg.inv(system)
    return found @ information.vector, 0.5 * (found + found.T)


class Selection:
    """Evidence of sets of hypotheses, each computed once."""

    def __init__(
        self, information: Information, nominal: FloatArray, candidates: Sequence[Hypothesis]
    ) -> None:
        self.information = information
        self.nominal = nominal
        self.candidates = tuple(candidates)
        self._known: dict[frozenset[Hypothesis], float] = {}

    def prior(self, chosen: frozenset[Hypothesis]) -> FloatArray:
        """Prior covariance of the errors, (G, G), with these causes."""
        covariance = self.nominal.copy()
        for each in chosen:
            covariance[each.rows, each.rows] += np.square(each.sigmas)
        return covariance

    def evidence(self, chosen: frozenset[Hypothesis]) -> float:
        """Log evidence of a set of causes, with its prior odds."""
        if chosen not in self._known:
            odds = sum(each.log_odds - EVIDENCE_THRESHOLD for each in chosen)
            self._known[chosen] = log_evidence(self.information, self.prior(chosen)) + odds
        return self._known[chosen]

    def search(self, start: frozenset[Hypothesis] = frozenset()) -> frozenset[Hypothesis]:
        """Add, exchange or remove one cause at a time while the evidence grows."""
        chosen = start
        while True:
            best = max(self._neighbours(chosen), key=self.evidence)
            if self.evidence(best) <= self.evidence(chosen) + 1e-6:
                return chosen
            chosen = best

    def _neighbours(self, chosen: frozenset[Hypothesis]) -> list[frozenset[Hypothesis]]:
        others = [each for each in self.candidates if each not in chosen]
        neighbours = [chosen - {each} for each in chosen]
        neighbours += [chosen - {old} | {new} for old in chosen for new in others]
        # Two causes that one explained for a while.
        neighbours += [chosen - set(pair) | {new} for pair in combinations(chosen, 2) for new in others]
        if len(chosen) < MAX_CAUSES:
            neighbours += [chosen | {each} for each in others]
        return neighbours or [chosen]

    def single(self) -> dict[Hypothesis, float]:
        """Log Bayes factor of each cause alone against none."""
        none = self.evidence(frozenset())
        return {
            each: self.evidence(frozenset({each})) - none + EVIDENCE_THRESHOLD - each.log_odds
            for each in self.candidates
        }

    def summarise(self, chosen: frozenset[Hypothesis]) -> list[SelectedCause]:
        """Estimates and alternatives of the chosen causes, the most evident first."""
        mean, covariance = posterior(self.information, self.prior(chosen))
        found = []
        for each in chosen:
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
