"""Report section on the causes of errors that the diagnosis found. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from tsgt.analysis.report.page import UNKNOWN, Section, Table, format_number, format_share

if TYPE_CHECKING:
    from tsgt.analysis.diagnosis import Diagnosis, Finding

LISTED_HYPOTHESES = 10

COMPONENTS = ("range", "horizontal_angle", "zenith_angle")


def diagnosis_section(
    diagnosis: Diagnosis | None,
    problem: str | None,
    refinement: str = "",
    refined: tuple[tuple[str, ...], ...] = (),
) -> Section:
    """Return the section on the causes of errors.

    ``problem``: why they are unknown; ``refinement``, ``refined``: what of the set-up was refined, in words and as rows.
    """
    title = "Causes of errors"
    if diagnosis is None:
        return Section(title, (f"Unknown: {problem or 'there is no continuous trajectory'}.",))
    text = (
        "Errors of station frames, instruments, prisms and timestamps leave patterns in the measurements, by which they are told "
        "apart from noise. What to do about each is above."
    )
    tables = []
    if diagnosis.findings:
        tables.append(
            Table(
                "Causes that were found, the worst first; effect: displacement of the measured prisms (rms)",
                ("cause", "where", "size", "effect (mm)", "probability", "or else"),
                tuple(_row(finding) for finding in diagnosis.findings),
            )
        )
    else:
        text += " None was found."
    factors = noise_factors(diagnosis)
    if factors:
        rows = tuple(
            (station, *(format_number(each[name], 2) for name in COMPONENTS))
            for station, each in factors.items()
        )
        caption = "Noise of the measurements relative to the stated noise (1: as stated), after these causes were removed"
        tables.append(Table(caption, ("station", "distance", "horizontal angle", "zenith angle"), rows))
    if diagnosis.held_out:
        rows = tuple((part.name, str(part.n), format_number(part.ratio, 2)) for part in diagnosis.held_out)
        caption = "Mean prediction error of held-out measurements by the estimator continuous, relative to linear (below 1: better)"
        tables.append(Table(caption, ("part of the drive", "measurements", "ratio"), rows))
    if refined:
        caption = (
            "What may be wrong in the set-up: each estimate as if it alone were, with one sigma; the log Bayes factor is the "
            "evidence for it against the set-up as recorded (above 5: very strong)"
        )
        tables.append(
            Table(caption, ("what", "estimate", "log Bayes factor", "refined"), refined[:LISTED_HYPOTHESES])
        )
    return Section(title, (text, *filter(None, [refinement])), tuple(tables))


def noise_factors(diagnosis: Diagnosis) -> dict[str, dict[str, float]]:
    """Return the factors on the stated noise by station and component."""
    return {
        str(number): dict(zip(COMPONENTS, factors, strict=True))
        for number, factors in diagnosis.noise.items()
    }


def diagnosis_numbers(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the same numbers for ``--json``."""
    return {
        "diagnosis": diagnosis.numbers(),
        "diagnosis_noise_scales": noise_factors(diagnosis),
        "held_out_ratios": [
            {"part": part.name, "n": part.n, "continuous_to_linear": part.ratio}
            for part in diagnosis.held_out
        ],
    }


def _row(finding: Finding) -> tuple[str, ...]:
    size = (
        ""
        if math.isnan(finding.size)
        else f"{_rounded(finding.size)} ± {_rounded(finding.sigma)} {finding.unit}"
    )
    effect = UNKNOWN if math.isnan(finding.effect_mm) else f"{finding.effect_mm:.1f}"
    return (
        finding.cause.replace("_", " "),
        finding.where,
        size or UNKNOWN,
        effect,
        format_share(finding.confidence),
        ", ".join(finding.alternatives) or "none",
    )


def _rounded(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else UNKNOWN
