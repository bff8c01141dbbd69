"""Report figures of the six components of poses: themselves with their sigmas, and their errors against a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import COMPONENTS
from tsgt.analysis.figures import curve, envelope, legend_above, plain_log, stroke

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tsgt.analysis.evaluation import PoseComponents
    from tsgt.analysis.figures import TimeAxis
    from tsgt.geometry import FloatArray

_BAND = "#9ecae1"  # light enough for a black curve in front of it, in grey too


def draw_components(figure: Figure, poses: PoseComponents, axis: TimeAxis) -> None:
    """Draw the six components over time, each with a band of two sigmas, and the sigmas beside them."""
    axes = figure.subplots(6, 2, sharex=True, gridspec_kw={"width_ratios": (3, 2)})
    time = axis.of(poses.stamp_ns)
    for row, name in enumerate(COMPONENTS):
        value, sigma = poses.value[:, row].copy(), poses.sigma[:, row]
        if row >= 3:
            value = np.degrees(value)
            # The line must not cross the panel where an angle passes 180 degrees.
            value[np.flatnonzero(np.abs(np.diff(value)) > 180.0)] = np.nan
        left, right = axes[row]
        _band(left, time, value, 2 * (sigma if row < 3 else np.degrees(sigma)))
        curve(left, time, value, 0, label="pose", dashes=False)
        left.ticklabel_format(axis="y", useOffset=False)
        left.set_ylabel(f"{name} ({'m' if row < 3 else 'deg'})")
        for number, (part, label) in enumerate(
            ((sigma, "whole standard deviation"), (poses.sigma_common[:, row], "part common to all poses"))
        ):
            if np.isfinite(part).any():
                x, most = envelope(time, _small_unit(row) * part)
                look = stroke(number + 1)
                right.plot(
                    x,
                    most,
                    color=look.color,
                    linestyle="-" if not number else "--",
                    linewidth=0.9,
                    label=label,
                )
        plain_log(right.yaxis)
        right.set_ylabel("mm" if row < 3 else "deg")
    axes[0, 0].set_title("pose")
    axes[0, 1].set_title("standard deviation")
    figure.supxlabel(axis.label, fontsize=8)
    legend_above(figure, axes[0])
    figure.align_ylabels(axes[:, 0])
    figure.align_ylabels(axes[:, 1])


def draw_component_errors(figure: Figure, errors: PoseComponents, axis: TimeAxis) -> None:
    """Draw the errors of the six components over time in a band of two stated sigmas, with rms and share within the band."""
    axes = figure.subplots(6, 1, sharex=True)
    time = axis.of(errors.stamp_ns)
    breaks = _breaks(errors.stamp_ns)
    time = np.insert(time, breaks, np.nan)
    for row, (panel, name) in enumerate(zip(axes, COMPONENTS, strict=True)):
        scale = _small_unit(row)
        value = np.insert(scale * errors.value[:, row], breaks, np.nan)
        sigma = np.insert(scale * errors.sigma[:, row], breaks, np.nan)
        x, most = envelope(time, 2 * sigma)
        panel.fill_between(x, -most, most, color=_BAND, linewidth=0, label="2 stated standard deviations")
        common = np.insert(scale * errors.sigma_common[:, row], breaks, np.nan)
        if np.isfinite(common).any():
            x, most = envelope(time, 2 * common)
            for side in (-1, 1):
                label = "their part common to all poses" if side > 0 else None
                panel.plot(x, side * most, color="#404040", linestyle="--", linewidth=0.8, label=label)
        curve(panel, time, value, 0, label="error", dashes=False)
        panel.axhline(0.0, color="black", linewidth=0.5)
        unit, digits = ("mm", 1) if row < 3 else ("deg", 3)
        panel.set_ylabel(f"{name}\n({unit})")
        panel.set_title(
            f"rms {scale * errors.rms[row]:.{digits}f} {unit}, {errors.within_two_sigma[row]:.1%} within 2 sigma",
            loc="right",
            fontsize=7,
            pad=2,
        )
        known = np.abs(value[np.isfinite(value)])
        reach = max(1.05 * known.max(initial=0.0), 3 * np.nanmedian(sigma)) if len(known) else 1.0
        panel.set_ylim(-reach, reach)
    axes[-1].set_xlabel(axis.label)
    figure.align_ylabels(axes)
    legend_above(figure, [axes[0]])


def _small_unit(row: int) -> float:
    """Return the factor from m to mm, or from rad to degrees."""
    return 1e3 if row < 3 else 180.0 / np.pi


def _band(panel: Axes, time: FloatArray, value: FloatArray, half_width: FloatArray) -> None:
    step = max(1, len(time) // 1500)
    low, high = (value - half_width)[::step], (value + half_width)[::step]
    panel.fill_between(time[::step], low, high, color=_BAND, linewidth=0, label="2 standard deviations")


def _breaks(stamp_ns: np.ndarray) -> np.ndarray:
    """Return where epochs are missing."""
    steps = np.diff(stamp_ns)
    return np.flatnonzero(steps > 2 * np.median(steps)) + 1 if len(steps) else np.empty(0, np.intp)
