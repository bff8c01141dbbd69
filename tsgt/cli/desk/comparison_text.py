"""Results of ``tsgt compare`` as text."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import click
import numpy as np

from tsgt.analysis.comparison_report import notes
from tsgt.cli.output import print_table, printable
from tsgt.geometry import log_so3

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.analysis.compare import Comparison, JudgedErrors

_MARK = "*"
_FOOTNOTE = f"{_MARK} below the reference's resolution: what it has beyond the part that the reference's uncertainty explains is less than that part"


def print_comparisons(found: Sequence[Comparison]) -> None:
    """Print one column per estimate, then what each fitted quantity hides, then what to note."""
    rows = [(title, [cell(each) for each in found]) for title, cell in _ROWS]
    rows += _relative_rows(found)
    print_table(
        ["", *(printable(each.name) for each in found)],
        [[title, *cells] for title, cells in rows if any(cell != "-" for cell in cells)],
    )
    if any(_MARK in cell for _, cells in rows for cell in cells):
        click.echo(_FOOTNOTE)
    for each in found:
        click.echo(f"\nWhat the fitted quantities of {printable(each.name)} hide")
        print_table(
            ["fitted", "position rms (mm)", "rotation rms (deg)", ""],
            [
                [
                    step.label,
                    _number(step.ate.errors.position_mm.rms, 1),
                    _number(step.ate.errors.orientation_deg.rms, 3),
                    "smallest fair set" if row == each.smallest_fair else "" if step.fair else "hides drift",
                ]
                for row, step in enumerate(each.steps)
            ],
        )
    for each in found:
        for line in notes(each):
            click.echo(f"note: {printable(each.name)}: {printable(line).replace('`', '')}", err=True)


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _with_sigma(value: float, sigma: float, digits: int) -> str:
    text = _number(value, digits)
    return f"{text} ± {_number(sigma, digits)}" if math.isfinite(sigma) else f"{text} fixed"


def _offset(each: Comparison) -> str:
    return _with_sigma(1e3 * each.fit.relation.offset_s, 1e3 * float(each.sigma("offset_s")[0]), 2)


def _skew(each: Comparison) -> str:
    if "skew" not in each.settings.parts:
        return "-"
    return _with_sigma(1e6 * each.fit.relation.skew, 1e6 * float(each.sigma("skew")[0]), 2)


def _scale(each: Comparison) -> str:
    if "scale" not in each.settings.parts:
        return "-"
    return _with_sigma(each.fit.relation.scale, float(each.sigma("scale")[0]), 5)


def _extrinsic(row: int) -> Callable[[Comparison], str]:
    def cell(each: Comparison) -> str:
        T = each.fit.relation.T_point_sensor
        if row < 3:
            return _with_sigma(1e3 * float(T[row, 3]), 1e3 * float(each.extrinsic_sigma[row]), 1)
        angle = float(np.degrees(log_so3(T[:3, :3]))[row - 3])
        return _with_sigma(angle, math.degrees(float(each.extrinsic_sigma[row])), 3)

    return cell


def _position(judged: JudgedErrors) -> str:
    return _number(judged.errors.position_mm.rms, 1) + (_MARK if judged.position_below_resolution else "")


def _orientation(judged: JudgedErrors) -> str:
    return _number(judged.errors.orientation_deg.rms, 3) + (
        _MARK if judged.orientation_below_resolution else ""
    )


def _nees(each: Comparison) -> str:
    found = each.errors.nees
    if found is None:
        return "-"
    return f"{_number(found.statistics.mean, 1)} ({found.degrees_of_freedom})"


_ROWS: tuple[tuple[str, Callable[[Comparison], str]], ...] = (
    ("poses compared", lambda c: f"{c.errors.completeness.compared} of {c.errors.completeness.poses}"),
    ("share of the reference's time", lambda c: f"{c.errors.completeness.share:.1%}"),
    ("gaps; jumps", lambda c: f"{len(c.errors.completeness.gaps)}; {len(c.errors.completeness.jumps)}"),
    ("time offset (ms)", _offset),
    ("clock skew (ppm)", _skew),
    *((f"extrinsic {name} (mm)", _extrinsic(row)) for row, name in enumerate("xyz")),
    *((f"extrinsic rotation {name} (deg)", _extrinsic(3 + row)) for row, name in enumerate("xyz")),
    ("scale", _scale),
    ("ATE position, rms (mm)", lambda c: _position(c.errors.ate)),
    ("  explained by the reference", lambda c: _number(c.errors.ate.explained.position_rms_mm, 1)),
    ("  sigma from the fitted quantities", lambda c: _number(1e3 * c.fit.ate_sigma_m, 1)),
    ("ATE rotation, rms (deg)", lambda c: _orientation(c.errors.ate)),
    ("  explained by the reference", lambda c: _number(c.errors.ate.explained.orientation_rms_deg, 3)),
    ("everything aligned: position (mm)", lambda c: _position(c.fully_aligned.ate)),
    ("  sigma from the fitted quantities", lambda c: _number(1e3 * c.fully_aligned.fit.ate_sigma_m, 1)),
    ("everything aligned: rotation (deg)", lambda c: _orientation(c.fully_aligned.ate)),
    ("drift (mm/m)", lambda c: _number(c.errors.drift.position_mm_per_m, 2)),
    ("drift (deg/m)", lambda c: _number(c.errors.drift.orientation_deg_per_m, 4)),
    ("NEES (expected)", _nees),
)


def _relative_rows(found: Sequence[Comparison]) -> list[tuple[str, list[str]]]:
    rows = []
    kinds = dict.fromkeys(
        (each.delta, each.unit) for c in found for each in c.errors.rpe if each.pairs == "all"
    )
    for delta, unit in kinds:
        chosen = [
            next((r.judged for r in c.errors.rpe if (r.delta, r.unit, r.pairs) == (delta, unit, "all")), None)
            for c in found
        ]
        for title, cell in (
            (f"RPE over {delta:g} {unit} (mm)", _position),
            ("  rotation (deg)", _orientation),
        ):
            rows.append((title, ["-" if judged is None else cell(judged) for judged in chosen]))
    return rows
