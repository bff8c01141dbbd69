"""The diagnosis of a recording: all findings, the worst first. Sans-I/O."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.diagnosis.diagnose import analyse
from tsgt.analysis.diagnosis.finding import setup_findings, with_distances
from tsgt.analysis.diagnosis.held_out_finding import held_out_finding, held_out_parts
from tsgt.analysis.diagnosis.noise_findings import noise_findings
from tsgt.analysis.diagnosis.target_findings import calibration_findings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.analysis.diagnosis.finding import Finding
    from tsgt.analysis.diagnosis.held_out_finding import Part
    from tsgt.analysis.evaluation import HeldOutErrors, InterPrismDistances, Predictor
    from tsgt.analysis.smoothing import MotionModel, SmoothedRecording
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import Parameters


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Findings on a recording, the worst first, and the figures behind them.

    Attributes
    ----------
    noise : Factors on the stated noise by station and component, with the set-up corrected.
    held_out : Ratios by part of the recording; empty without held-out errors.
    """

    findings: tuple[Finding, ...]
    noise: dict[int, tuple[float, ...]]
    held_out: tuple[Part, ...] = ()

    def numbers(self) -> list[dict[str, Any]]:
        """Return the findings for ``--json``; null for what has no size."""
        return [_numbers(each) for each in self.findings]


def diagnose(
    parameters: Parameters,
    observations: Observations,
    motion: MotionModel,
    *,
    held_out: Mapping[Predictor, HeldOutErrors] | None = None,
    distances: InterPrismDistances | None = None,
) -> Diagnosis:
    """Diagnose a recording.

    ``observations``: its measurements with the recorded set-up and the stated noise; ``motion``: estimated from them; ``held_out``: errors of the same measurements; ``distances``:
    between its prisms. Raises GeometryError: the measurements do not determine a trajectory.
    """
    analysis = analyse(observations, parameters, motion)
    layout_m = np.array([each.position_m for each in parameters.prisms])
    findings = [
        *with_distances(setup_findings(analysis, layout_m), distances),
        *noise_findings(analysis),
        *calibration_findings(parameters),
    ]
    findings.sort(key=lambda each: -(50.0 if math.isnan(each.effect_mm) else each.effect_mm))
    parts = held_out_parts(observations, held_out, analysis.layout.prisms) if held_out else []
    worse = held_out_finding(parts, findings)
    return Diagnosis(
        tuple(findings if worse is None else [worse, *findings]),
        {
            number: tuple(analysis.noise.factors[row].tolist())
            for row, number in enumerate(analysis.layout.stations)
        },
        tuple(parts),
    )


def diagnose_smoothed(
    parameters: Parameters,
    smoothed: SmoothedRecording,
    *,
    held_out: Mapping[Predictor, HeldOutErrors] | None = None,
    distances: InterPrismDistances | None = None,
) -> Diagnosis:
    """Diagnose a smoothed recording; see :func:`diagnose`."""
    return diagnose(
        parameters,
        smoothed.observations_with(parameters),
        smoothed.motion,
        held_out=held_out,
        distances=distances,
    )


def _numbers(finding: Finding) -> dict[str, Any]:
    fields = dataclasses.asdict(finding)
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in fields.items()
    }
