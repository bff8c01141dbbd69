"""Figure of the perturbation study: pose errors over noise on the prisms."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures.style import PAGE_WIDTH_MM, STROKES, drawing, save

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from tsgt.analysis.design import Perturbation
    from tsgt.geometry import FloatArray

_HEIGHT_MM = 95.0
_NAMES = (("x", "y", "z", "length"), ("roll", "pitch", "yaw", "angle"))
_UNITS = ("position error (mm)", "rotation error (rad)")


def draw_perturbation(
    study: Sequence[Perturbation], first_order_per_mm: tuple[FloatArray, FloatArray], paths: Sequence[Path]
) -> None:
    """Draw mean and standard deviation of the pose errors over the noise, per axis and of the norm.

    Parameters
    ----------
    study : In the order of the noise.
    first_order_per_mm : Sigmas of position (m) and rotation (rad) for 1 mm of noise, (3,) each.

    Raises
    ------
    MissingExtraError, OutputFileError : matplotlib is not installed; a file cannot be written.
    """
    noise_mm = np.array([1e3 * each.noise_m for each in study])
    position_mm = 1e3 * np.array(
        [
            [(*each.position_mean_m, each.position_norm_mean_m) for each in study],
            [(*each.position_std_m, each.position_norm_std_m) for each in study],
        ]
    )
    rotation_rad = np.array(
        [
            [(*each.euler_mean_rad, each.rotation_norm_mean_rad) for each in study],
            [(*each.euler_std_rad, each.rotation_norm_std_rad) for each in study],
        ]
    )
    expected = (np.outer(noise_mm, 1e3 * first_order_per_mm[0]), np.outer(noise_mm, first_order_per_mm[1]))
    with drawing(width_mm=PAGE_WIDTH_MM, height_mm=_HEIGHT_MM) as figure:
        axes = figure.subplots(2, 4, sharex=True, sharey="row")
        for row, (mean, std) in enumerate((position_mm, rotation_rad)):
            for column, name in enumerate(_NAMES[row]):
                panel = axes[row, column]
                _band(panel, noise_mm, mean[:, column], std[:, column])
                if column < 3:
                    _first_order(panel, noise_mm, expected[row][:, column])
                panel.set_title(name)
            axes[row, 0].set_ylabel(_UNITS[row])
            # Scale to the samples: a diverging first-order line must not compress them.
            low, high = (mean - std).min(), (mean + std).max()
            room = 0.08 * (high - low) or 1.0
            axes[row, 0].set_ylim(low - room, high + room)
        axes[0, 0].locator_params(axis="x", nbins=2)
        axes[0, 0].set_xlim(noise_mm[0], noise_mm[-1] if len(noise_mm) > 1 else noise_mm[0] + 1)
        figure.supxlabel("noise of each prism coordinate, one sigma (mm)", fontsize=8)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)
        for path in paths:
            save(figure, path)


def _band(panel: Axes, noise_mm: FloatArray, mean: FloatArray, std: FloatArray) -> None:
    stroke = STROKES[1]
    panel.fill_between(
        noise_mm, mean - std, mean + std, color=stroke.color, alpha=0.25, linewidth=0, label="mean ± std"
    )
    panel.plot(noise_mm, mean, color=stroke.color, label="mean")


def _first_order(panel: Axes, noise_mm: FloatArray, sigma: FloatArray) -> None:
    stroke = STROKES[0]
    for side, label in ((1, "± std to first order"), (-1, None)):
        panel.plot(noise_mm, side * sigma, color=stroke.color, linestyle=":", linewidth=1.0, label=label)
