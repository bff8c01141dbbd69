"""Refinement of the set-up of a recording within its batch solution."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from tsgt.errors import GeometryError
from tsgt.estimation import parameter_names
from tsgt.geometry.motion_calibration import Setup, SetupParameters, calibrated_covariance, refine_setup

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import Hypothesis, RefinedSetup
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import MotionPrior, Parameters

Refine = Literal["auto", "off", "prisms"]
"""What may be refined where the data disagree with the set-up: frames, latencies and instrument errors (``auto``), nothing,
or the prisms as well."""


def refine_recorded_setup(
    parameters: Parameters,
    observations: Observations,
    prior: MotionPrior,
    noise_scales: FloatArray,
    refine: Refine,
) -> RefinedSetup | None:
    """Refine the set-up of observations, whose parameters state it and its covariance.

    ``prior`` and ``noise_scales``: tuned with that set-up. None: switched off, or the measurements are too few or not polar.
    """
    if refine == "off":
        return None
    setup = Setup.of(observations)
    try:
        layout = SetupParameters.of_observations(observations, setup)
        covariance = calibrated_covariance(
            layout, parameter_names(layout, parameters), parameters.setup_covariance
        )
        return refine_setup(observations, layout, covariance, prior, noise_scales, prisms=refine == "prisms")
    except GeometryError:
        return None


def refinement_keys(refined: RefinedSetup | None, parameters: Parameters) -> dict[str, Any]:
    """Return for ``--json`` what the measurements say about the set-up, and what was refined."""
    if refined is None:
        return {"refinement": None}
    return {
        "refinement": {
            "used": refined.used,
            "log_bayes_factor": refined.log_bayes_factor,
            "p_value": refined.p_value,
            "birge_ratio": refined.birge_ratio,
            "wander_ms": 1e3 * refined.wander_s,
            "groups": [
                {
                    "kind": each.hypothesis.kind,
                    _subject(each.hypothesis): _number(each.hypothesis, parameters),
                    "log_bayes_factor": each.log_bayes_factor,
                    "selected": each.selected,
                    "components": list(each.hypothesis.components),
                    "estimate": each.estimate.tolist(),
                    "sigma": each.sigma.tolist(),
                }
                for each in sorted(refined.evidence, key=lambda each: -each.log_bayes_factor)
            ],
        }
    }


def refinement_text(refined: RefinedSetup | None, parameters: Parameters) -> str:
    """Return in words what was refined."""
    if refined is None:
        return "Set-up: as recorded, not compared with the measurements"
    if not refined.used:
        return "Set-up: as recorded; the measurements do not contradict it"
    selected = [
        f"{each.hypothesis.kind.replace('_', ' ')} of "
        f"{_subject(each.hypothesis)} {_number(each.hypothesis, parameters)}"
        for each in refined.evidence
        if each.selected
    ]
    beyond = f", beyond its stated uncertainty: {', '.join(selected)}" if selected else ""
    return f"Set-up: refined within the trajectory{beyond}"


def _number(hypothesis: Hypothesis, parameters: Parameters) -> int:
    """Return the number of the station or prism that a hypothesis is about."""
    if hypothesis.kind == "prism":
        return parameters.prisms[hypothesis.row].prism
    return parameters.stations[hypothesis.row].station


def _subject(hypothesis: Hypothesis) -> str:
    return "prism" if hypothesis.kind == "prism" else "station"
