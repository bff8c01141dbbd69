"""Report figures: map, both estimators, residuals, and the effect of prism noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import PREDICTOR_NAMES
from tsgt.analysis.figures import curve, dots, stroke

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from tsgt.analysis.design import Perturbation
    from tsgt.analysis.evaluation import HeldOutErrors, Predictor
    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.report.findings import Difference
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray

_SIGHT = ("along the line\nof sight", "horizontally\nacross it", "vertically\nacross it")


def draw_map(figure: Figure, poses: PoseBatch, stations: Mapping[int, FloatArray]) -> None:
    """Draw the path from above with the stations, by number (3,) in frame ``station1``; interrupted where no pose is valid."""
    panel = figure.subplots()
    xy = np.where(poses.valid[:, None], poses.position_m, np.nan)[:, :2]
    step = max(1, len(xy) // 20_000)
    panel.plot(*xy[::step].T, color=stroke(1).color, linewidth=0.9, label="robot")
    ends = np.flatnonzero(poses.valid)[[0, -1]]
    for row, (end, name) in enumerate(zip(ends, ("start", "end"), strict=True)):
        panel.plot(
            *xy[end],
            linestyle="none",
            marker="os"[row],
            markersize=5,
            markerfacecolor="white" if row == 0 else "black",
            markeredgecolor="black",
            label=name,
        )
    for row, (number, position) in enumerate(stations.items()):
        panel.plot(
            *position[:2],
            linestyle="none",
            marker="^",
            markersize=6,
            color=stroke(2).color,
            label="station" if row == 0 else None,
        )
        x, y = position[:2].tolist()
        panel.annotate(str(number), (x, y), textcoords="offset points", xytext=(5, 3), fontsize=7)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel("x in frame station1 (m)")
    panel.set_ylabel("y in frame station1 (m)")
    figure.legend(loc="outside upper center", ncols=4)


def draw_held_out(figure: Figure, held_out: Mapping[Predictor, HeldOutErrors]) -> None:
    """Draw the cumulative distribution of the held-out prediction errors of each estimator."""
    parts = [
        (gap, title)
        for gap, title in ((False, "gaps up to 1 s"), (True, "gaps over 1 s"))
        if any((each.at_gap == gap).any() for each in held_out.values())
    ]
    axes = figure.subplots(1, max(1, len(parts)), sharey=True, squeeze=False)[0]
    for panel, (gap, title) in zip(axes, parts, strict=False):
        reach_mm = 0.0
        for row, (name, each) in enumerate(held_out.items()):
            chosen = np.sort(1e3 * each.error_m[each.at_gap == gap])
            share = 100 * np.arange(1, len(chosen) + 1) / max(1, len(chosen))
            look = stroke(row)
            panel.plot(chosen, share, color=look.color, linestyle=look.linestyle, label=PREDICTOR_NAMES[name])
            # The largest errors would compress all others.
            reach_mm = max(reach_mm, 1.2 * np.percentile(chosen, 97) if len(chosen) else 0.0)
        panel.set_xlim(0.0, reach_mm or 1.0)
        panel.set_title(title, loc="left")
        panel.set_xlabel("prediction error (mm)")
    axes[0].set_ylabel("share with a smaller error (%)")
    axes[0].set_ylim(0, 101)  # a curve at 100 % is visible
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)


def draw_difference(figure: Figure, difference: Difference, axis: TimeAxis, point: str) -> None:
    """Draw the difference between the poses of the two estimators, positions at a point of this name."""
    axes = figure.subplots(2, 1, sharex=True)
    time, position, rotation = _with_gaps(difference)
    curve(axes[0], axis.of(time), 1e3 * position, 1, label=None, dashes=False)
    curve(axes[1], axis.of(time), np.degrees(rotation), 1, label=None, dashes=False)
    axes[0].set_ylabel(f"{point}\n(mm)")
    axes[1].set_ylabel("rotation (deg)")
    for panel in axes:
        panel.set_ylim(bottom=0.0)
    axes[1].set_xlabel(axis.label)
    figure.align_ylabels(axes)


def draw_residuals(
    figure: Figure,
    normalised: FloatArray,
    stamp_ns: NDArray[np.int64],
    station: NDArray[np.int64],
    axis: TimeAxis,
) -> None:
    """Draw residuals (M, 3), in sigmas along, horizontally and vertically across the line of sight, by station over time."""
    numbers = np.unique(station).tolist()
    axes = figure.subplots(len(numbers), 3, sharex=True, sharey=True, squeeze=False)
    for row, number in enumerate(numbers):
        rows = station == number
        for column, name in enumerate(_SIGHT):
            panel = axes[row, column]
            # Values further out are drawn at the edge: the table of outliers lists them.
            dots(panel, axis.of(stamp_ns[rows]), np.clip(normalised[rows, column], -5.8, 5.8), 1)
            for limit in (-3.0, 3.0):
                panel.axhline(limit, color="black", linestyle="--", linewidth=0.8)
            panel.axhline(0.0, color="black", linewidth=0.6)
            if row == 0:
                panel.set_title(name)
        axes[row, 0].set_ylabel(f"station {number}\n(sigmas)")
    axes[0, 0].set_ylim(-6, 6)
    figure.supxlabel(axis.label, fontsize=8)


def draw_perturbation(figure: Figure, study: Sequence[Perturbation], measured_m: float) -> None:
    """Draw the standard deviations of the pose error along each axis, and its mean norm, over the noise of the prisms."""
    axes = figure.subplots(1, 2, sharex=True)
    noise_mm = [1e3 * each.noise_m for each in study]
    position_mm = 1e3 * np.array([(*each.position_std_m, each.position_norm_mean_m) for each in study])
    rotation_deg = np.degrees([(*each.euler_std_rad, each.rotation_norm_mean_rad) for each in study])
    panels = (
        (axes[0], position_mm, ("x", "y", "z", "mean length"), "error of the prisms' centroid (mm)"),
        (axes[1], rotation_deg, ("roll", "pitch", "yaw", "mean angle"), "rotation error (deg)"),
    )
    for panel, values, names, label in panels:
        for row, name in enumerate(names):
            look = stroke(row)
            panel.plot(
                noise_mm,
                values[:, row],
                color=look.color,
                linestyle=look.linestyle,
                label=name,
            )
            panel.plot(
                noise_mm[::5], values[::5, row], color=look.color, linestyle="none", marker=look.marker
            )
        panel.axvline(1e3 * measured_m, color="black", linestyle=":", linewidth=0.8)
        panel.set_ylabel(label)
        panel.set_xlim(0.0, noise_mm[-1])
        panel.set_ylim(bottom=0.0)
        panel.legend(loc="upper left")
    figure.supxlabel("noise of each prism coordinate, 1 sigma (mm)", fontsize=8)


def _with_gaps(difference: Difference) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Insert NaN where epochs are missing, so that the line is interrupted."""
    steps = np.diff(difference.stamp_ns)
    if not len(steps):
        return difference.stamp_ns, difference.position_m, difference.rotation_rad
    breaks = np.flatnonzero(steps > 2 * np.median(steps)) + 1
    return (
        np.insert(difference.stamp_ns, breaks, difference.stamp_ns[breaks] - 1),
        np.insert(difference.position_m, breaks, np.nan),
        np.insert(difference.rotation_rad, breaks, np.nan),
    )
