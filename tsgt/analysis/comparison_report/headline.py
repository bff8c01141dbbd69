"""First part of the page of a comparison: key figures, what to trust, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.comparison_report.notes import cautions, undetermined
from tsgt.analysis.report import Headline, format_number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.compare import Comparison


def comparison_headline(found: Sequence[Comparison]) -> Headline:
    """Return the headline: position error of each estimate, and what its figure rests on."""
    trust, caution, repairs = [], [], []
    for each in found:
        ate, fair = each.errors.ate, each.steps[each.smallest_fair]
        trust.append(
            f"{each.name}: {format_number(ate.errors.position_mm.rms)} mm rms with {_fitted(each)} fitted, of which the reference "
            f"explains {format_number(ate.explained.position_rms_mm)} mm; {format_number(each.fully_aligned.ate.errors.position_mm.rms)} mm "
            "with everything aligned."
        )
        if ate.position_below_resolution:
            caution.append(
                f"{each.name}: its position error is below the reference's resolution; it may be better than this figure."
            )
        caution += [f"{each.name}: {line}." for line in cautions(each)]
        if "extrinsic" in fair.settings.parts - each.settings.parts:
            repairs.append(
                f"{each.name}: fit the extrinsic with `--fit offset,extrinsic`, or give it with `--extrinsic FILE`."
            )
    weak = [
        each.name
        for each in found
        if any(name.startswith("extrinsic") for name in (*each.weakly_determined, *undetermined(each)))
        and "extrinsic" in each.settings.parts
    ]
    if weak:
        repairs.append(
            f"{', '.join(weak)}: for a closer extrinsic drive curves both ways with changing speed, on uneven ground, or give it from CAD "
            "with its sigmas (`--extrinsic FILE`)."
        )
    figures = tuple(
        (f"{each.name}, position rms", f"{format_number(each.errors.ate.errors.position_mm.rms)} mm")
        for each in found
    )
    return Headline(figures, tuple(trust), tuple(caution), tuple(repairs))


def _fitted(each: Comparison) -> str:
    own = next((step for step in each.steps if step.fit is each.fit), None)
    return own.label if own is not None else ", ".join(sorted(each.settings.parts)) or "nothing"
