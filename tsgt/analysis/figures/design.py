"""Figures of ``tsgt analyse layout`` and of the perturbation study."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.design import HEADING_COUNT
from tsgt.analysis.figures.style import PAGE_WIDTH_MM, STROKES, drawing, save
from tsgt.estimation import point_label, point_place
from tsgt.model import ROBOT_FRAME

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from tsgt.analysis.design import Perturbation, PoseAccuracy
    from tsgt.geometry import FloatArray
    from tsgt.model import ReferencePoint

_LAYOUT_HEIGHT_MM = 115.0


def draw_layouts(
    covariances: Mapping[str, FloatArray],
    distances: Mapping[float, Mapping[str, PoseAccuracy]],
    point: ReferencePoint,
    path: Path,
) -> None:
    """Draw the layouts over the robot's heading, and the first one over distance and arrangement of the stations.

    ``covariances``: by name in the order of the ranking, (N, 6, 6) of robot poses with
    :data:`tsgt.analysis.design.layout_study.HEADING_COUNT` headings at each place. ``distances``: by the stations' distance
    in m and the name of their arrangement. ``point``: that of the positions. Raises MissingExtraError without matplotlib,
    OutputFileError if it cannot write.
    """
    heading_deg = np.arange(HEADING_COUNT + 1) * (360 / HEADING_COUNT)
    distance_m = list(distances)
    with drawing(width_mm=PAGE_WIDTH_MM, height_mm=_LAYOUT_HEIGHT_MM) as figure:
        axes = figure.subplots(2, 2, sharex="col", sharey="row")
        for (name, covariance), stroke in zip(covariances.items(), cycle(STROKES)):
            variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, HEADING_COUNT, 2, 3)
            sigmas = 1e3 * np.sqrt(variances.sum(axis=-1).mean(axis=0))
            for row in range(2):
                closed = np.append(sigmas[:, row], sigmas[0, row])
                axes[row, 0].plot(heading_deg, closed, **stroke._asdict(), label=name)
        for arrangement, stroke in zip(next(iter(distances.values())), cycle(STROKES)):
            found = [by_name[arrangement] for by_name in distances.values()]
            for row, sigmas_m in enumerate(([f.position_m for f in found], [f.rotation_rad for f in found])):
                axes[row, 1].plot(distance_m, 1e3 * np.array(sigmas_m), **stroke._asdict(), label=arrangement)
        labels = (
            f"one sigma of the position (mm)\nof {_point_text(point)}",
            "one sigma of the rotation (mrad)",
        )
        for row, unit in enumerate(labels):
            axes[row, 0].set_ylabel(unit)
            axes[row, 0].set_ylim(bottom=0)
        axes[1, 0].set_xticks(range(0, 361, 90))
        axes[1, 0].set_xlabel("heading of the robot (°)")
        axes[1, 1].set_xscale("log")
        axes[1, 1].set_xticks(distance_m, [f"{d:g}" for d in distance_m])
        axes[1, 1].minorticks_off()
        axes[1, 1].set_xlabel("distance of the stations (m)")
        first = next(iter(covariances))
        for column, title in enumerate(("layout", f"arrangement of the stations, with {first}")):
            # Above the panel, where no curve can run.
            axes[0, column].legend(title=title, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
        save(figure, path)


_STUDY_HEIGHT_MM = 95.0
_PANEL_TITLES = (("x", "y", "z", "length"), ("roll", "pitch", "yaw", "angle"))


def draw_perturbation(
    study: Sequence[Perturbation],
    first_order_per_mm: tuple[FloatArray, FloatArray],
    point: ReferencePoint,
    paths: Sequence[Path],
) -> None:
    """Draw mean and standard deviation of the pose errors over the noise, per axis and of the norm.

    ``study``: in the order of the noise. ``first_order_per_mm``: sigmas of position (m) and rotation (rad) for 1 mm of
    noise, (3,) each. ``point`` and exceptions as for :func:`draw_layouts`.
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
    with drawing(width_mm=PAGE_WIDTH_MM, height_mm=_STUDY_HEIGHT_MM) as figure:
        axes = figure.subplots(2, 4, sharex=True, sharey="row")
        for row, (mean, std) in enumerate((position_mm, rotation_rad)):
            for column, name in enumerate(_PANEL_TITLES[row]):
                panel = axes[row, column]
                _band(panel, noise_mm, mean[:, column], std[:, column])
                if column < 3:
                    _first_order(panel, noise_mm, expected[row][:, column])
                panel.set_title(name)
            position_label = f"position error (mm)\nof {_point_text(point)}"
            axes[row, 0].set_ylabel("rotation error (rad)" if row else position_label)
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


def _point_text(point: ReferencePoint) -> str:
    """Name the point, and say on a second line where it is."""
    return point_label(point) + ("" if point.name == ROBOT_FRAME else f"\nat {point_place(point)}")


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
