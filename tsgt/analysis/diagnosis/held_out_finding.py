"""Where ``continuous`` predicts held-out measurements no better than ``linear``, and why. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.diagnosis.finding import Finding
from tsgt.analysis.evaluation import folds

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from tsgt.analysis.evaluation import HeldOutErrors, Predictor
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import Observations

HELD_OUT = "held_out"
CLEARLY_BETTER = 0.8  # Ratio of mean errors
MIN_POINTS = 20
MOVING_MPS = 0.1
_LEFT_OUT = 0.01  # Share of the worst points that a ratio must not depend on


@dataclass(frozen=True, slots=True)
class Part:
    """Held-out points of one part of a recording: their number, and mean error of ``continuous`` over that of ``linear``."""

    name: str
    n: int
    ratio: float


def held_out_parts(
    observations: Observations, held_out: Mapping[Predictor, HeldOutErrors], prisms: Sequence[int]
) -> list[Part]:
    """Ratios of all points that are not at gaps, and of near and far, standing and moving ones, and of each prism."""
    splits = folds(observations)
    if not splits:
        return []
    rows = np.concatenate([fold.test for fold in splits])
    at_gap = np.concatenate([fold.at_gap for fold in splits])
    linear, continuous = held_out["linear"].error_m, held_out["continuous"].error_m
    distance_m = np.linalg.norm(observations.points_m, axis=1)[rows]
    moving = _speeds_mps(observations)[rows] > MOVING_MPS
    median_m = float(np.median(distance_m))
    parts: dict[str, NDArray[np.bool_]] = {
        "all": np.ones(len(rows), np.bool_),
        f"nearer than {median_m:.0f} m": distance_m <= median_m,
        f"farther than {median_m:.0f} m": distance_m > median_m,
        "standing": ~moving,
        "moving": moving,
        **{f"prism {number}": observations.prism[rows] == row for row, number in enumerate(prisms)},
    }
    return [
        Part(
            name,
            int(np.sum(inside & ~at_gap)),
            _ratio(continuous[inside & ~at_gap], linear[inside & ~at_gap]),
        )
        for name, inside in parts.items()
    ]


def _ratio(continuous_m: FloatArray, linear_m: FloatArray) -> float:
    """Ratio of means without the points that are worst for either."""
    if not len(linear_m):
        return math.nan
    worst = np.maximum(continuous_m, linear_m)
    kept = np.argsort(worst)[: len(worst) - int(_LEFT_OUT * len(worst))]
    return float(continuous_m[kept].mean() / max(float(linear_m[kept].mean()), 1e-12))


def _speeds_mps(observations: Observations) -> FloatArray:
    """(M,) speed of the measured prism by its neighbours of the same station, over about a second."""
    speeds = np.zeros(len(observations))
    points = observations.in_world()
    for station in np.unique(observations.station):
        own = np.flatnonzero(observations.station == station)
        first, last = (
            np.maximum(np.arange(len(own)) - 1, 0),
            np.minimum(np.arange(len(own)) + 1, len(own) - 1),
        )
        step_s = np.maximum(observations.time_s[own[last]] - observations.time_s[own[first]], 1e-3)
        speeds[own] = np.linalg.norm(points[own[last]] - points[own[first]], axis=1) / step_s
    return speeds


def held_out_finding(parts: Sequence[Part], causes: Sequence[Finding]) -> Finding | None:
    """Say where ``continuous`` is not clearly better, and why; None if it is in every part."""
    sufficient = [part for part in parts if part.n >= MIN_POINTS]
    weak = [part for part in sufficient if part.ratio > CLEARLY_BETTER and part.name != "all"]
    whole = next((part for part in sufficient if part.name == "all"), None)
    if whole is None or whole.ratio <= CLEARLY_BETTER:
        return None
    listed = ", ".join(f"{part.name} {part.ratio:.2f}" for part in weak)
    geometry = [each for each in causes if each.effect_mm > 0 or math.isnan(each.effect_mm)]
    why = (
        f"The reason is below: {geometry[0].text}"
        if geometry
        else "No error of set-up or noise was found: the robot moves so steadily that straight lines predict as well, or it stands."
    )
    return Finding(
        cause=HELD_OUT,
        where="continuous",
        size=whole.ratio,
        sigma=math.nan,
        unit="",
        effect_mm=math.nan,
        confidence=0.95,
        text=f"Continuous predicts held-out measurements no better than linear: {whole.ratio:.2f} of its mean error"
        + (f" ({listed})" if listed else "")
        + f". {why}",
        repair=geometry[0].repair if geometry else "",
        evidence={part.name: {"ratio": part.ratio, "n": part.n} for part in parts},
    )
