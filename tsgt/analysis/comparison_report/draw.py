"""Figures of a comparison: maps, errors over time, over distance and by motion, and what the fit hides."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import curve, envelope, hatch, legend_above, narrow, note, plain_log, stroke
from tsgt.geometry import invert

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from tsgt.analysis.compare import Comparison
    from tsgt.analysis.evaluation import Bins
    from tsgt.analysis.figures import TimeAxis
    from tsgt.geometry import FloatArray

MAP_POINTS = 4000
BUCKETS = 1500  # As curves are thinned
WIDE_RANGE = 200.0  # Of a logarithmic axis, above which a narrow figure has room for powers of ten only
_BAND = "#9ecae1"  # light enough for a black curve in front of it, in grey too
_REFERENCE = "#808080"


def draw_map(figure: Figure, found: Sequence[Comparison]) -> None:
    """Draw the reference and each estimate from above, in frame ``station1``, of the reference's point."""
    panel = figure.subplots()
    for row, each in enumerate(found):
        pairs = each.errors.pairs
        breaks = _breaks(pairs.stamp_ns)
        T_sensor_point = invert(each.fit.relation.T_point_sensor)
        reference, estimated = (
            np.insert((T @ T_sensor_point)[:, :2, 3], breaks, np.nan, axis=0)
            for T in (pairs.reference, pairs.estimated)
        )
        step = max(1, len(reference) // 20_000)
        if row == 0:
            panel.plot(
                *reference[::step].T,
                color=_REFERENCE,
                linewidth=2.5,
                label="reference",
                solid_capstyle="round",
            )
            panel.plot(
                *reference[0],
                linestyle="none",
                marker="o",
                markersize=5,
                markerfacecolor="white",
                markeredgecolor="black",
                label="start",
                zorder=5,
            )
        look = stroke(row + 1)
        panel.plot(*estimated[::step].T, color=look.color, linewidth=0.8, label=each.name)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel("x in frame station1 (m)")
    panel.set_ylabel("y in frame station1 (m)")
    legend_above(figure, [panel])


def draw_error_maps(figure: Figure, found: Sequence[Comparison]) -> None:
    """Draw the path from above, coloured by the position error of each estimate."""
    shown = [1e3 * each.errors.series.position_m for each in found]
    top = max(float(np.percentile(each, 98)) for each in shown)
    columns = 1 if narrow(figure) else min(len(found), 3)
    rows = -(-len(found) // columns)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    image = None
    for panel, each, error_mm in zip(axes.flat, found, shown, strict=False):
        position = each.errors.pairs.reference[:, :2, 3]
        step = max(1, len(position) // MAP_POINTS)
        image = panel.scatter(
            *position[::step].T,
            c=error_mm[::step],
            s=3,
            cmap="viridis",
            vmin=0.0,
            vmax=top or 1.0,
            linewidths=0,
            rasterized=True,
        )
        panel.set_title(each.name, loc="left")
        panel.set_aspect("equal", adjustable="box")
    for panel in axes.flat[len(found) :]:
        panel.set_visible(False)
    if image is not None:
        figure.colorbar(image, ax=axes, label="position error (mm)", shrink=0.8, extend="max")
    figure.supxlabel("x in frame station1 (m)", fontsize=8)
    figure.supylabel("y in frame station1 (m)", fontsize=8)


def draw_errors_over_time(figure: Figure, found: Sequence[Comparison], axis: TimeAxis) -> None:
    """Draw position and rotation error over time, with what the reference explains."""
    axes = figure.subplots(2, 1, sharex=True)
    for row, each in enumerate(found):
        series = each.errors.series
        breaks = _breaks(series.stamp_ns)
        time = _interrupted(axis.of(series.stamp_ns), breaks)
        for panel, value in zip(
            axes, (1e3 * series.position_m, np.degrees(series.rotation_rad)), strict=True
        ):
            if np.isfinite(value).any():
                curve(panel, time, _interrupted(value, breaks), row + 1, label=each.name)
    _resolution_band(axes, found[0], axis)
    for panel, label in zip(axes, ("position\nerror (mm)", "rotation\nerror (deg)"), strict=True):
        if panel.lines:
            plain_log(panel.yaxis)
        else:
            note(panel, "no orientations")
        panel.set_ylabel(label)
    axes[-1].set_xlabel(axis.label)
    figure.align_ylabels(axes)
    legend_above(figure, list(axes))


def _resolution_band(axes: Sequence[Axes], each: Comparison, axis: TimeAxis) -> None:
    c = each.errors.series.components
    breaks = _breaks(c.stamp_ns)
    time = _interrupted(axis.of(c.stamp_ns), breaks)
    for panel, columns, scale in ((axes[0], slice(0, 3), 1e3), (axes[1], slice(3, 6), 180.0 / np.pi)):
        size = scale * np.sqrt((c.sigma[:, columns] ** 2).sum(axis=1))
        if np.isfinite(size).any() and panel.lines:
            x, most = envelope(time, _interrupted(size, breaks))
            bottom = 0.5 * float(np.nanmin(size[size > 0], initial=np.nanmax(size)))
            panel.fill_between(
                x, bottom, most, color=_BAND, linewidth=0, label="1 sigma of the reference", zorder=0
            )


def draw_travel_errors(figure: Figure, each: Comparison, axis: TimeAxis) -> None:
    """Draw the errors in the axes of travel over time, each with a band of two sigmas of the reference."""
    from tsgt.analysis.compare import TRAVEL_COMPONENTS  # noqa: PLC0415

    c = each.errors.series.components
    shown = 6 if each.errors.pairs.has_orientation else 3
    axes = figure.subplots(shown, 1, sharex=True)
    breaks = _breaks(c.stamp_ns)
    time = _interrupted(axis.of(c.stamp_ns), breaks)
    for row, (panel, name) in enumerate(zip(axes, TRAVEL_COMPONENTS, strict=False)):
        scale, unit, digits = (1e3, "mm", 1) if row < 3 else (180.0 / np.pi, "deg", 3)
        value, sigma = (_interrupted(scale * v[:, row], breaks) for v in (c.value, c.sigma))
        if np.isfinite(sigma).any():
            x, most = envelope(time, 2 * sigma)
            panel.fill_between(x, -most, most, color=_BAND, linewidth=0, label="2 sigma of the reference")
        curve(panel, time, value, 0, label="error", dashes=False)
        panel.axhline(0.0, color="black", linewidth=0.5)
        panel.set_ylabel(f"{name}\n({unit})")
        panel.set_title(f"rms {scale * c.rms[row]:.{digits}f} {unit}", loc="right", fontsize=7, pad=2)
    axes[-1].set_xlabel(axis.label)
    figure.align_ylabels(axes)
    legend_above(figure, [axes[0]])


def draw_drift(figure: Figure, found: Sequence[Comparison]) -> None:
    """Draw the error of the motion over the distance driven, and what the reference's uncertainty explains of it."""
    axes = figure.subplots(1, 2)
    for row, each in enumerate(found):
        segments = each.errors.drift.curve
        if not segments:
            continue
        length = np.array([s.length_m for s in segments])
        position = np.array([10.0 * s.position_percent * s.length_m for s in segments])
        rotation = np.array([s.orientation_deg_per_m * s.length_m for s in segments])
        explained = np.array([10.0 * s.explained_percent * s.length_m for s in segments])
        look = stroke(row + 1)
        for panel, value in zip(axes, (position, rotation), strict=True):
            if np.isfinite(value).any():
                panel.plot(
                    length,
                    value,
                    color=look.color,
                    linestyle=look.linestyle,
                    marker=look.marker,
                    markersize=4,
                    label=each.name,
                )
        if row == 0 and np.isfinite(explained).any():
            label = "explained by the reference"
            axes[0].fill_between(
                length,
                0.3 * min(float(np.nanmin(explained)), float(np.nanmin(position))),
                explained,
                color=_BAND,
                linewidth=0,
                label=label if len(found) == 1 else f"{label} ({each.name})",
                zorder=0,
            )
    for panel, label in zip(axes, ("mean position error (mm)", "mean rotation error (deg)"), strict=True):
        panel.set_ylabel(label)
        if panel.lines:
            plain_log(panel.xaxis)
            plain_log(panel.yaxis)
        else:
            note(panel, "nothing to show")
    figure.supxlabel("distance driven (m)", fontsize=8)
    legend_above(figure, list(axes))


def draw_steps(figure: Figure, found: Sequence[Comparison]) -> None:
    """Draw the position error with growing sets of fitted quantities as bars."""
    panel = figure.subplots()
    labels = list(dict.fromkeys(step.label for each in found for step in each.steps))
    height = 0.8 / len(found)
    for row, each in enumerate(found):
        place = np.array([labels.index(step.label) for step in each.steps]) + row * height
        value = [step.ate.errors.position_mm.rms for step in each.steps]
        look = stroke(row + 1)
        panel.barh(
            place,
            value,
            height=0.92 * height,
            color=look.color,
            hatch=hatch(row),
            edgecolor="white",
            linewidth=0.4,
            label=each.name,
        )
        fair = each.steps[each.smallest_fair]
        panel.plot(
            fair.ate.errors.position_mm.rms,
            labels.index(fair.label) + row * height,
            linestyle="none",
            marker="D",
            markersize=4,
            color="black",
            label="smallest fair set" if row == 0 else None,
        )
    panel.set_yticks(np.arange(len(labels)) + 0.4 - 0.5 * height, [_wrapped(label) for label in labels])
    panel.invert_yaxis()
    plain_log(panel.xaxis)
    low, high = panel.get_xlim()
    if narrow(figure) and high > WIDE_RANGE * low:
        from matplotlib.ticker import LogLocator  # noqa: PLC0415 (an extra)

        panel.xaxis.set_major_locator(LogLocator())
    panel.set_xlabel("ATE position, rms (mm)")
    legend_above(figure, [panel])


def _wrapped(label: str) -> str:
    return label.replace(", ", ",\n")


def draw_by_motion(figure: Figure, found: Sequence[Comparison]) -> None:
    """Draw median and 95th percentile of the position error by speed and turn rate."""
    axes = figure.subplots(1, 2, sharey=True)
    for row, each in enumerate(found):
        series = each.errors.series
        _bins(axes[0], series.by_speed(), row, each.name, 1.0)
        _bins(axes[1], series.by_turn_rate(), row, each.name, 180.0 / np.pi)
    for panel, label in zip(axes, ("speed (m/s)", "turn rate (deg/s)"), strict=True):
        panel.set_xlabel(label)
        if panel.lines:
            panel.set_yscale("log")
            plain_log(panel.yaxis)
        else:
            note(panel, "too few poses, or no motion")
    axes[0].set_ylabel("position error (mm)")
    legend_above(figure, list(axes))


def _bins(panel: Axes, bins: Bins | None, row: int, name: str, scale: float) -> None:
    if bins is None:
        return
    middle = scale * 0.5 * (bins.edges[1:] + bins.edges[:-1])
    look = stroke(row + 1)
    known: NDArray[np.bool_] = np.isfinite(bins.median)
    panel.plot(
        middle[known],
        1e3 * bins.median[known],
        color=look.color,
        linestyle=look.linestyle,
        marker=look.marker,
        markersize=4,
        label=f"{name}, median",
    )
    panel.plot(
        middle[known],
        1e3 * bins.p95[known],
        color=look.color,
        linestyle="none",
        marker=look.marker,
        markersize=4,
        markerfacecolor="none",
        label=f"{name}, 95 %",
    )


def _interrupted(values: FloatArray, breaks: NDArray[np.intp]) -> FloatArray:
    """Insert NaN at the breaks, enough that one remains where a long curve is thinned."""
    return np.insert(values, np.repeat(breaks, 2 * (1 + len(values) // BUCKETS)), np.nan)


def _breaks(stamp_ns: FloatArray | NDArray[np.int64]) -> NDArray[np.intp]:
    """Return where poses are missing: the line is interrupted there."""
    steps = np.diff(stamp_ns)
    return np.flatnonzero(steps > max(5 * np.median(steps), 5e8)) + 1 if len(steps) else np.empty(0, np.intp)
