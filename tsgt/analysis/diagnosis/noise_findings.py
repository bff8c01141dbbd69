"""Findings on noise, loss of lock and outliers. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.diagnosis.finding import LOCK_LOSS, NOISE, OUTLIERS, Finding

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.analysis.diagnosis.diagnose import Analysis

MIN_NOISE_FACTOR = 1.5  # On the stated noise, beyond which it counts as larger
_NOISE_SIGMAS = 4.0
_COMPONENTS = ("range", "horizontal angle", "zenith angle")


def noise_findings(analysis: Analysis) -> list[Finding]:
    """Return findings on noise, loss of lock and outliers."""
    found = []
    noise = analysis.noise
    for axis, component in enumerate(_COMPONENTS):
        larger = [
            row
            for row in range(len(analysis.layout.stations))
            if min(noise.factors[row, axis], noise.robust[row, axis]) > MIN_NOISE_FACTOR
            and noise.factors[row, axis] - 1.0 > _NOISE_SIGMAS * noise.sigmas[row, axis]
        ]
        if not larger:
            continue
        factors = {analysis.layout.stations[row]: float(noise.factors[row, axis]) for row in larger}
        where = _stations(factors)
        stated = ", ".join(
            f"{factors[n]:.1f} ± {noise.sigmas[row, axis]:.1f}"
            for n, row in zip(factors, larger, strict=True)
        )
        found.append(
            Finding(
                cause=NOISE,
                where=f"{where}, {component}",
                size=float(np.sqrt(np.mean(np.square(list(factors.values()))))),
                sigma=float(max(noise.sigmas[row, axis] for row in larger)),
                unit="",
                effect_mm=math.nan,
                confidence=0.99,
                text=f"The noise of {where} is larger than stated: {component} {stated} times. The set-up does not explain it.",
                repair="Look for heat shimmer, vibration of tripods, dirt on prisms, and a second prism in view; state the noise "
                "in the configuration (`noise_scale`), so that live poses have the right covariance.",
                evidence={
                    "factors": factors,
                    "robust": {n: float(noise.robust[r, axis]) for n, r in zip(factors, larger, strict=True)},
                },
            )
        )
    if analysis.lock_loss is not None:
        found.append(_lock_loss_finding(analysis))
    if len(analysis.outliers):
        found.append(_outlier_finding(analysis))
    return found


def _lock_loss_finding(analysis: Analysis) -> Finding:
    loss = analysis.lock_loss
    assert loss is not None  # noqa: S101 (the caller has checked)
    return Finding(
        cause=LOCK_LOSS,
        where="all stations",
        size=1e3 * loss.rms_m,
        sigma=1e3 * loss.rms_m / math.sqrt(2.0 * loss.measurements),
        unit="mm",
        effect_mm=1e3 * loss.rms_m,
        confidence=1.0 - min(loss.p_value, 1.0),
        text=f"Locks drift off the prism before they are lost, or settle after: {loss.measurements} measurements near "
        f"{loss.gaps} of {loss.all_gaps} gaps are off by {1e3 * loss.rms_m:.0f} mm (rms), at most {1e3 * loss.max_m:.0f} mm.",
        repair="Do not trust poses within a second of a gap of a station. Drive slower where the line of sight is interrupted, "
        "and keep other reflecting surfaces out of view.",
        evidence={
            "gaps": loss.gaps,
            "of": loss.all_gaps,
            "p_value": loss.p_value,
            "max_mm": 1e3 * loss.max_m,
        },
    )


def _outlier_finding(analysis: Analysis) -> Finding:
    rows = analysis.outliers
    stations = analysis.linearised.observations.station[rows]
    counts = {
        number: int(np.sum(stations == row))
        for row, number in enumerate(analysis.layout.stations)
        if (stations == row).any()
    }
    sizes_mm = 1e3 * np.linalg.norm(analysis.linearised.residuals_m[rows], axis=1)
    listed = "".join(f"station {number} {count}, " for number, count in counts.items())
    return Finding(
        cause=OUTLIERS,
        # Imported points are not attached to a station.
        where=_stations(counts) if counts else "imported points",
        size=float(np.median(sizes_mm)),
        sigma=math.nan,
        unit="mm",
        effect_mm=0.0,
        confidence=0.99,
        text=f"{len(rows)} single measurement{'s are' if len(rows) > 1 else ' is'} grossly wrong ({listed}"
        f"{sizes_mm.min():.0f} to {sizes_mm.max():.0f} mm); the trajectory does without.",
        repair="Nothing, if they are few. Otherwise look for reflections and for other prisms in view.",
        evidence={"count": counts, "largest_mm": float(sizes_mm.max())},
    )


def _stations(numbers: Iterable[int]) -> str:
    listed = [str(number) for number in numbers]
    if len(listed) == 1:
        return f"station {listed[0]}"
    return f"stations {', '.join(listed[:-1])} and {listed[-1]}"
