"""Refinement of the set-up of a recording within its batch solution."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from tsgt.errors import GeometryError
from tsgt.estimation import parameter_names
from tsgt.geometry.motion_calibration import Setup, SetupParameters, calibrated_covariance, refine_setup
from tsgt.geometry.motion_calibration.refinement import MIN_LOG_BAYES_FACTOR_OF_USE

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import Hypothesis, HypothesisEvidence, HypothesisKind, RefinedSetup
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import MotionPrior, Parameters

Refine = Literal["auto", "off", "prisms"]
"""What may be refined where the data disagree with the set-up: frames, latencies and instrument errors (``auto``), nothing,
or the prisms as well."""

_DOUBTFUL_P_VALUE, _DOUBTFUL_LOG_BAYES_FACTOR = 0.01, 5.0  # Beyond one of them a set-up is not called right


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
    if not refined.used and (
        refined.p_value < _DOUBTFUL_P_VALUE or refined.log_bayes_factor > _DOUBTFUL_LOG_BAYES_FACTOR
    ):
        return (
            "Set-up: as recorded; not refined: the evidence against it is below the limit of its use, log Bayes factor "
            f"{refined.log_bayes_factor:.1f} of {MIN_LOG_BAYES_FACTOR_OF_USE:.0f} (p-value {refined.p_value:.2g}); tsgt evaluate "
            "--report lists what may be wrong"
        )
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


def refinement_rows(refined: RefinedSetup | None, parameters: Parameters) -> tuple[tuple[str, ...], ...]:
    """Return what may have been wrong, the most likely first: its name, estimates, log Bayes factor, and whether it was refined.

    Each estimate is what follows if this alone was wrong, with one sigma. Empty where nothing was compared.
    """
    if refined is None:
        return ()
    return tuple(
        (
            f"{each.hypothesis.kind.replace('_', ' ')}, {_subject(each.hypothesis)} {_number(each.hypothesis, parameters)}",
            _estimates(each),
            f"{each.log_bayes_factor:.1f}",
            "yes" if refined.used and each.selected else "no",
        )
        for each in sorted(refined.evidence, key=lambda each: -each.log_bayes_factor)
    )


def _estimates(evidence: HypothesisEvidence) -> str:
    """Return the estimates of a hypothesis with one sigma, in the units of the field."""
    kind = evidence.hypothesis.kind
    parts = []
    for name, value, sigma in zip(
        evidence.hypothesis.components, evidence.estimate.tolist(), evidence.sigma.tolist(), strict=True
    ):
        factor, unit = _ROTATION if name.startswith("rotation") else _UNITS[kind]
        digits = {"mm": 1, "ppm": 1, "ms": 2, "mrad": 3}[unit]
        parts.append(f"{name} {factor * value:.{digits}f} ± {factor * sigma:.{digits}f} {unit}".strip())
    return ", ".join(parts).replace("_", " ")


_ROTATION = (1e3, "mrad")
_UNITS: dict[HypothesisKind, tuple[float, str]] = {
    "frame": (1e3, "mm"),
    "turned": _ROTATION,
    "latency": (1e3, "ms"),
    "vertical_index": _ROTATION,
    "collimation": _ROTATION,
    "prism_constant": (1e3, "mm"),
    "range_scale": (1e6, "ppm"),
    "prism": (1e3, "mm"),
}


def _number(hypothesis: Hypothesis, parameters: Parameters) -> int:
    """Return the number of the station or prism that a hypothesis is about."""
    if hypothesis.kind == "prism":
        return parameters.prisms[hypothesis.row].prism
    return parameters.stations[hypothesis.row].station


def _subject(hypothesis: Hypothesis) -> str:
    return "prism" if hypothesis.kind == "prism" else "station"
