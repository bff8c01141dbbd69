"""Figure of ``tsgt analyse layout``: accuracy over the robot's heading and the stations' distance."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.design import HEADING_COUNT
from tsgt.analysis.figures.style import PAGE_WIDTH_MM, STROKES, drawing, save

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from tsgt.analysis.design import PoseAccuracy
    from tsgt.geometry import FloatArray

_HEIGHT_MM = 115.0
_UNITS = ("position, one sigma (mm)", "rotation, one sigma (mrad)")


def draw_layouts(
    covariances: Mapping[str, FloatArray],
    distances: Mapping[float, Mapping[str, PoseAccuracy]],
    path: Path,
) -> None:
    """Draw the layouts over the robot's heading, and the first one over distance and arrangement of the stations.

    Parameters
    ----------
    covariances
        By name of the layout, in the order of the ranking: (N, 6, 6) of robot poses with
        :data:`tsgt.analysis.design.layout_study.HEADING_COUNT` headings at each place.
    distances : By the stations' distance in m and the name of their arrangement.

    Raises
    ------
    MissingExtraError, OutputFileError : matplotlib is not installed; the file cannot be written.
    """
    heading_deg = np.arange(HEADING_COUNT + 1) * (360 / HEADING_COUNT)
    distance_m = list(distances)
    with drawing(width_mm=PAGE_WIDTH_MM, height_mm=_HEIGHT_MM) as figure:
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
        for row, unit in enumerate(_UNITS):
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
