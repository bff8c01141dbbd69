"""Sections of the page of a comparison."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare import TRAVEL_COMPONENTS
from tsgt.analysis.comparison_report import draw
from tsgt.analysis.figures import TimeAxis, panels_height_mm
from tsgt.analysis.report import (
    MAX_LISTED,
    ReportFigure,
    Section,
    Table,
    format_cells,
    format_number,
    format_share,
    format_utc,
)
from tsgt.geometry import log_so3

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.compare import Comparison

_FAIREST = "\N{BLACK DIAMOND}"


def comparison_map(found: Sequence[Comparison]) -> ReportFigure:
    """Return the map."""
    return ReportFigure(
        "map",
        "Estimates and reference from above",
        "Paths of the reference's point, by each estimate as fitted. Lines are interrupted where there is no pose or no reference.",
        110.0,
        lambda figure: draw.draw_map(figure, found),
    )


def comparison_sections(found: Sequence[Comparison]) -> list[Section]:
    """Return all sections."""
    start_ns = min(int(each.errors.series.stamp_ns[0]) for each in found)
    end_ns = max(int(each.errors.series.stamp_ns[-1]) for each in found)
    axis = TimeAxis.over(start_ns, end_ns)
    axis = replace(axis, label=axis.label.replace("measurement", "pose"))
    return [
        _side_by_side(found),
        _relations(found),
        _hidden(found),
        _over_time(found, axis),
        _motions(found),
        _by_motion(found),
        _completeness(found),
    ]


def _side_by_side(found: Sequence[Comparison]) -> Section:
    rows = []
    for each in found:
        a = each.errors.ate
        p, r, e = a.errors.position_mm, a.errors.orientation_deg, a.explained
        rows.append(
            format_cells(
                each.name,
                (a.errors.n, 0),
                *((value, 1) for value in (p.rms, e.position_rms_mm, p.median, p.max)),
                *((value, 3) for value in (r.rms, e.orientation_rms_deg)),
                (each.fully_aligned.ate.errors.position_mm.rms, 1),
                (each.fully_aligned.ate.errors.orientation_deg.rms, 3),
            )
        )
    table = Table(
        "Absolute error (ATE), as evo defines it, and how much of its rms the reference's own uncertainty explains; at the right "
        "with everything aligned",
        (
            *("estimate", "poses", "rms (mm)", "explained (mm)", "median (mm)", "max (mm)"),
            *("rms (deg)", "explained (deg)", "all aligned (mm)", "all aligned (deg)"),
        ),
        tuple(rows),
    )
    text = (
        "Errors of the sensor's pose against the reference at the same instants. An error whose part beyond the explained one is "
        "less than that part is below the reference's resolution."
    )
    return Section(
        "Estimates side by side",
        (text,),
        (table, _components(found), *_consistency(found)),
    )


def _components(found: Sequence[Comparison]) -> Table:
    rows = []
    for each in found:
        keys = each.errors.series.component_keys()
        figures = [(value, 1 if row < 3 else 3) for row, value in enumerate(_rms_and_mean(keys))]
        rows.append(format_cells(each.name, *figures))
    header = [f"{name} ({'mm' if row < 3 else 'deg'})" for row, name in enumerate(TRAVEL_COMPONENTS)]
    return Table(
        "Root mean square by component: along the horizontal direction of travel, to its left, and up; rotations about these axes",
        ("estimate", *header),
        tuple(rows),
    )


def _rms_and_mean(keys: dict[str, dict[str, float]]) -> list[float]:
    return [figures["rms"] for figures in keys.values()]


def _consistency(found: Sequence[Comparison]) -> list[Table]:
    rows = [
        (
            each.name,
            str(n.degrees_of_freedom),
            format_number(n.statistics.mean),
            format_share(n.statistics.above_95),
        )
        for each in found
        if (n := each.errors.nees) is not None
    ]
    if not rows:
        return []
    return [
        Table(
            "Squared errors in units of the estimate's covariance and the reference's (NEES)",
            ("estimate", "expected", "mean", "above its 95 % point (expected 5 %)"),
            tuple(rows),
        )
    ]


def _relations(found: Sequence[Comparison]) -> Section:
    places, turns = [], []
    has_scale = any("scale" in each.settings.parts for each in found)
    for each in found:
        relation, sigma = each.fit.relation, each.extrinsic_sigma
        position_mm = 1e3 * relation.T_point_sensor[:3, 3]
        rotation_deg = np.degrees(log_so3(relation.T_point_sensor[:3, :3]))
        scale = _with_sigma(relation.scale, float(each.sigma("scale")[0]), 5)
        places.append(
            (
                each.name,
                _with_sigma(1e3 * relation.offset_s, 1e3 * float(each.sigma("offset_s")[0]), 2),
                *(_with_sigma(v, 1e3 * s, 1) for v, s in zip(position_mm, sigma[:3], strict=True)),
                *((scale,) if has_scale else ()),
            )
        )
        turned = [_with_sigma(v, math.degrees(s), 3) for v, s in zip(rotation_deg, sigma[3:], strict=True)]
        if each.errors.pairs.has_orientation:
            turns.append((each.name, *turned))
    header = ("estimate", "offset (ms)", "x (mm)", "y (mm)", "z (mm)", *(("scale",) if has_scale else ()))
    tables = [
        Table(
            "Time on the reference's clock less the estimate's stamp, and position of the sensor in the axes of the reference's "
            "point. One sigma, which allows for the estimate's drift; without one it was not fitted",
            header,
            tuple(places),
        )
    ]
    if turns:
        tables.append(
            Table(
                "Rotation vector of the sensor", ("estimate", "x (deg)", "y (deg)", "z (deg)"), tuple(turns)
            )
        )
    return Section("Relation between estimate and reference", tables=tuple(tables))


def _with_sigma(value: float, sigma: float, digits: int) -> str:
    text = format_number(float(value), digits)
    return (
        f"{text}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{format_number(sigma, digits)}"
        if math.isfinite(sigma)
        else text
    )


def _hidden(found: Sequence[Comparison]) -> Section:
    labels = list(dict.fromkeys(step.label for each in found for step in each.steps))
    positions: list[tuple[str, ...]] = []
    rotations: list[tuple[str, ...]] = []
    for label in labels:
        steps = [next((step for step in each.steps if step.label == label), None) for each in found]
        fairest = [step is each.steps[each.smallest_fair] for each, step in zip(found, steps, strict=True)]
        for rows, name, digits in ((positions, "position_mm", 1), (rotations, "orientation_deg", 3)):
            values = [math.nan if step is None else getattr(step.ate.errors, name).rms for step in steps]
            cells = [format_number(value, digits) for value in values]
            marked = [
                f"{_FAIREST} {cell}" if fair else cell for cell, fair in zip(cells, fairest, strict=True)
            ]
            rows.append((label, *marked))
    header = ("fitted", *(each.name for each in found))
    tables = [
        Table(f"Position error, rms in mm. {_FAIREST}: smallest fair set", header, tuple(positions)),
        Table(f"Rotation error, rms in degrees. {_FAIREST}: smallest fair set", header, tuple(rotations)),
    ]
    plot = ReportFigure(
        "fit",
        "What each fitted quantity hides",
        "Position error with growing sets of fitted quantities. Diamond: the smallest fair set.",
        25.0 + 5.0 * len(found[0].steps) * (1 + len(found)) * 0.8,
        lambda figure: draw.draw_steps(figure, found),
    )
    text = (
        "Clock, extrinsic and starting pose say nothing about the quality of an estimate: to fit them is fair. An alignment over all "
        "poses, or a scale, also hides drift. The smallest fair set is the first from which on no fair quantity reduces an error by "
        "more than 5 %."
    )
    return Section("What the fit hides", (text,), tuple(tables), (plot,))


def _over_time(found: Sequence[Comparison], axis: TimeAxis) -> Section:
    plots = [
        ReportFigure(
            "errors_over_time",
            "Errors over time",
            "Distance and angle between estimate and reference. Band: one standard deviation of the reference, of all three axes "
            "together.",
            panels_height_mm(3),
            lambda figure: draw.draw_errors_over_time(figure, found, axis),
        ),
        ReportFigure(
            "error_map",
            "Errors on the map",
            "Path of the reference, coloured by the position error of each estimate.",
            20.0 + 55.0 * -(-len(found) // 3),
            lambda figure: draw.draw_error_maps(figure, found),
            narrow_height_mm=20.0 + 45.0 * len(found),
        ),
    ]
    plots += [
        ReportFigure(
            f"components_{number}",
            f"Error by component: {each.name}",
            "Along the horizontal direction of travel, to its left, and up; rotations about these axes. Band: two standard deviations "
            "of the reference.",
            panels_height_mm(6 if each.errors.pairs.has_orientation else 3),
            lambda figure, each=each: draw.draw_travel_errors(figure, each, axis),  # type: ignore[misc]
        )
        for number, each in enumerate(found, start=1)
    ]
    return Section("Errors over time and on the map", plots=tuple(plots))


def _motions(found: Sequence[Comparison]) -> Section:
    rows = [
        format_cells(
            f"{each.name}, {r.delta:g} {r.unit}",
            (r.judged.errors.n, 0),
            *((value, 1) for value in (r.judged.errors.position_mm.rms, r.judged.explained.position_rms_mm)),
            *(
                (value, 3)
                for value in (r.judged.errors.orientation_deg.rms, r.judged.explained.orientation_rms_deg)
            ),
        )
        for each in found
        for r in each.errors.rpe
        if r.pairs == "all"
    ]
    relative = Table(
        "Relative error (RPE): error of the motion over a distance or a time, as evo computes it for all pairs, and how much of it "
        "the reference explains at most",
        ("estimate, motion", "pairs", "rms (mm)", "explained (mm)", "rms (deg)", "explained (deg)"),
        tuple(rows),
    )
    segments = [
        format_cells(
            f"{each.name}, {s.length_m:g} m",
            (s.n, 0),
            (s.position_percent, 3),
            (s.explained_percent, 3),
            (s.orientation_deg_per_m, 5),
        )
        for each in found
        for s in each.errors.drift.segments
    ]
    drift = Table(
        "Mean error over segments along the path, as in KITTI's benchmark",
        ("estimate, length", "segments", "position (%)", "explained (%)", "rotation (deg/m)"),
        tuple(segments),
    )
    text = []
    for each in found:
        drift_mm, drift_deg = each.errors.drift.position_mm_per_m, each.errors.drift.orientation_deg_per_m
        turned = f" and {format_number(drift_deg, 4)} degrees" if math.isfinite(drift_deg) else ""
        text.append(f"{each.name}: drift {format_number(drift_mm, 2)} mm{turned} per metre.")
    if any(each.errors.drift.shortened for each in found):
        text.append("The path is too short for KITTI's segments of 100 m to 800 m; shorter ones are used.")
    plot = ReportFigure(
        "drift",
        "Error of the motion over the distance driven",
        "Mean error over segments that start each second. Band: what the reference's uncertainty explains, at most.",
        70.0,
        lambda figure: draw.draw_drift(figure, found),
    )
    return Section("Errors of the motion", tuple(text), (relative, drift), (plot,))


def _by_motion(found: Sequence[Comparison]) -> Section:
    plot = ReportFigure(
        "by_motion",
        "Position error by speed and turn rate",
        "Median and 95th percentile in bins of the reference's motion with at least 20 poses. An error proportional to speed "
        "indicates a time offset, one proportional to the turn rate a wrong lever arm.",
        70.0,
        lambda figure: draw.draw_by_motion(figure, found),
    )
    return Section("Errors by speed and turn rate", plots=(plot,))


def _completeness(found: Sequence[Comparison]) -> Section:
    rows = []
    for each in found:
        c = each.errors.completeness
        rows.append(
            (
                each.name,
                str(c.poses),
                str(c.compared),
                str(c.outside),
                str(c.reference_gap),
                str(c.reference_weak),
                format_share(c.share),
                str(len(c.gaps)),
                str(len(c.jumps)),
                "no" if c.diverged_s is None else f"after {c.diverged_s:.0f} s",
            )
        )
    tables = [
        Table(
            "Poses, and the share of the reference's valid time that the estimate covers",
            (
                *("estimate", "poses", "compared", "outside", "reference invalid", "reference weak"),
                *("share of time", "gaps", "jumps", "diverged"),
            ),
            tuple(rows),
        )
    ]
    events = [
        (each.name, format_utc(gap.start_ns), "gap", f"{gap.duration_s:.1f} s")
        for each in found
        for gap in each.errors.completeness.gaps[:MAX_LISTED]
    ] + [
        (each.name, format_utc(jump.stamp_ns), "jump", _jump(jump.position_m, jump.rotation_rad))
        for each in found
        for jump in each.errors.completeness.jumps[:MAX_LISTED]
    ]
    if events:
        tables.append(
            Table(
                f"Gaps and jumps, at most {MAX_LISTED} each",
                ("estimate", "time (UTC)", "what", "size"),
                tuple(events),
            )
        )
    repaired = tuple(f"{each.name}: {note}." for each in found for note in each.estimate.notes)
    return Section("Completeness", repaired, tuple(tables))


def _jump(position_m: float, rotation_rad: float) -> str:
    turn = "" if math.isnan(rotation_rad) else f", {math.degrees(rotation_rad):.2f} deg"
    return f"{1e3 * position_m:.0f} mm{turn}"
