"""Findings in words: cause, size with uncertainty, how sure it is, how to repair it, and what measurement would decide. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.diagnosis.wording import CALIBRATE_MOTION, WORDING
from tsgt.geometry.motion_calibration import AMBIGUITY, SetupCause

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.analysis.diagnosis.diagnose import Analysis
    from tsgt.analysis.evaluation import InterPrismDistances
    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import CauseHypothesis, SelectedCause

GEOMETRY = "geometry"
NOISE = "noise"
LOCK_LOSS = "lock_loss"
OUTLIERS = "outliers"
TARGETS = "targets"

POOLED_THRESHOLD = (
    6.0  # Log Bayes factor of all causes together, beyond which the geometry is wrong in one way or another
)

_MIN_DISTANCES = 10
_LARGE_DEVIATION_MM = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One cause of errors.

    Attributes
    ----------
    cause, where : Kind, and the stations or prisms that it concerns, in words.
    size, sigma, unit : In the unit that the text uses; NaN where a size has no meaning.
    effect_mm : Displacement of the measured prisms that it causes (rms).
    confidence : Probability of this cause among those that were considered.
    text : A sentence.
    repair : An imperative sentence, commands in backquotes.
    deciding_measurement : What would decide between this cause and ``alternatives``; empty if it is decided.
    evidence : Figures behind it.
    """

    cause: str
    where: str
    size: float
    sigma: float
    unit: str
    effect_mm: float
    confidence: float
    text: str
    repair: str
    deciding_measurement: str = ""
    alternatives: tuple[str, ...] = ()
    evidence: dict[str, Any] = field(default_factory=dict)


def short_name(hypothesis: CauseHypothesis) -> str:
    """Name of a cause in a list."""
    return WORDING[hypothesis.cause].short.format(n=hypothesis.number)


def setup_findings(analysis: Analysis, layout_m: FloatArray) -> list[Finding]:
    """Return findings on the set-up; ``layout_m``, (P, 3), are the recorded prisms."""
    found = [
        _setup_finding(analysis, cause, effect_m, layout_m)
        for cause, effect_m in zip(analysis.causes, analysis.effects_m, strict=True)
    ]
    return found or _pooled(analysis)


def with_distances(findings: list[Finding], distances: InterPrismDistances | None) -> list[Finding]:
    """Add to the first finding by how much the measured distances between prisms deviate from the layout: medians."""
    if not findings or distances is None:
        return findings
    standing = any(len(pair.distances_m) >= _MIN_DISTANCES for pair in distances.static)
    deviations_mm = {
        pair.name: 1e3 * float(np.median(pair.distances_m) - pair.reference_m)
        for pair in (distances.static if standing else distances.dynamic)
        if len(pair.distances_m) >= _MIN_DISTANCES
    }
    large = {name: each for name, each in deviations_mm.items() if abs(each) > _LARGE_DEVIATION_MM}
    if not large:
        return findings
    listed = ", ".join(f"{name} {each:+.1f} mm" for name, each in large.items())
    when = "while the robot stands" if standing else "on average"
    first = findings[0]
    return [
        replace(
            first,
            text=f"{first.text} Measured distances between prisms differ from the layout {when}: {listed}.",
            evidence={**first.evidence, "distances_mm": deviations_mm},
        ),
        *findings[1:],
    ]


def _setup_finding(
    analysis: Analysis, selected: SelectedCause, effect_m: float, layout_m: FloatArray
) -> Finding:
    hypothesis = selected.hypothesis
    wording = WORDING[hypothesis.cause]
    length = float(np.linalg.norm(selected.estimate))
    direction = selected.estimate / length if length > 0 else np.eye(len(selected.estimate))[0]
    size, sigma = length, float(np.sqrt(direction @ selected.covariance @ direction))
    if len(selected.estimate) == 1:
        size *= float(direction[0])
    if hypothesis.cause in (SetupCause.FRAME, SetupCause.DRIFT):  # metres and radians: state it at the robot
        size, sigma = effect_m, effect_m * math.sqrt(1.0 / max(selected.log_bayes_factor, 1.0))
    size, sigma = size * wording.per_unit, sigma * wording.per_unit
    signed = len(selected.estimate) == 1
    digits = max(0, min(3, 1 - math.floor(math.log10(max(sigma, 1e-3)))))
    stated = f"{size:{'+' if signed else ''}.{digits}f} ± {sigma:.{digits}f} {wording.unit}"
    text = wording.phrase.format(n=hypothesis.number, size=stated)
    if hypothesis.cause is SetupCause.PRISM:
        text += _distance_changes(analysis, hypothesis.number, selected, layout_m)
    confidence = 1.0 / (
        1.0
        + math.exp(-min(selected.log_bayes_factor, 50.0))
        + sum(math.exp(-d) for _, d in selected.alternatives)
    )
    others = tuple(short_name(other) for other, _ in selected.alternatives)
    text += f"; this displaces its measurements by {1e3 * effect_m:.1f} mm."
    if others:
        text += f" Nearly as likely instead: {', '.join(others)}."
    return Finding(
        cause=str(hypothesis.cause),
        where=_where(hypothesis),
        size=size,
        sigma=sigma,
        unit=wording.unit,
        effect_mm=1e3 * effect_m,
        confidence=confidence,
        text=text,
        repair=wording.repair,
        deciding_measurement=_deciding(hypothesis, [other for other, _ in selected.alternatives]),
        alternatives=others,
        evidence={
            "log_bayes_factor": selected.log_bayes_factor,
            "alternatives": {short_name(other): difference for other, difference in selected.alternatives},
        },
    )


def _distance_changes(analysis: Analysis, number: int, selected: SelectedCause, layout_m: FloatArray) -> str:
    """Describe the changes of the prism's distances to the others, with sigmas."""
    row = analysis.layout.prisms.index(number)
    parts = []
    for other, name in enumerate(analysis.layout.prisms):
        if other != row:
            apart = layout_m[row] - layout_m[other]
            unit = apart / np.linalg.norm(apart)
            change, sigma = float(unit @ selected.estimate), float(np.sqrt(unit @ selected.covariance @ unit))
            parts.append(
                f"{min(number, name)}-{max(number, name)} {1e3 * change:+.1f} ± {1e3 * sigma:.1f} mm"
            )
    return f" (true distances less those of the layout: {', '.join(parts)})"


def _pooled(analysis: Analysis) -> list[Finding]:
    """One finding where the set-up is wrong in a way that the data cannot tell from others."""
    ranked = sorted(analysis.single.items(), key=lambda item: -(item[1] + item[0].log_odds))
    pooled = float(np.logaddexp.reduce([value + each.log_odds for each, value in ranked]))
    if pooled < POOLED_THRESHOLD:
        return []
    best = ranked[0][1] + ranked[0][0].log_odds
    likely = [each for each, value in ranked if value + each.log_odds > best - AMBIGUITY]
    names = [short_name(each) for each in likely]
    return [
        Finding(
            cause=GEOMETRY,
            where=", ".join(dict.fromkeys(_where(each) for each in likely)),
            size=math.nan,
            sigma=math.nan,
            unit="",
            effect_mm=math.nan,
            confidence=1.0 / (1.0 + math.exp(-pooled)),
            text="The geometry is wrong: station frames, instruments and prism layout contradict each other. The measurements do "
            f"not tell which of them: {', '.join(names)}.",
            repair=f"Refine the frames: {CALIBRATE_MOTION}.",
            deciding_measurement=_deciding(likely[0], likely[1:]),
            alternatives=tuple(names),
            evidence={"log_bayes_factor": pooled, "alternatives": {short_name(e): v for e, v in ranked[:6]}},
        )
    ]


def _deciding(hypothesis: CauseHypothesis, alternatives: Iterable[CauseHypothesis]) -> str:
    """Say what would decide between causes; empty if there is but one."""
    causes = list(dict.fromkeys([hypothesis.cause, *(each.cause for each in alternatives)]))
    if not any(True for _ in alternatives):
        return ""
    return "; or ".join(dict.fromkeys(WORDING[cause].decides for cause in causes[:3]))


def _where(hypothesis: CauseHypothesis) -> str:
    return f"{'prism' if hypothesis.cause is SetupCause.PRISM else 'station'} {hypothesis.number}"
