"""What the sections of a report are made with: figures on paper, numbers and times as people read them."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import PAGE_WIDTH_MM, drawing, save
from tsgt.analysis.report.page import ReportFigure

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from tsgt.geometry import FloatArray

LISTED = 20
"""So many rows of a list that may be long."""


def wide(name: str, caption: str, height_mm: float, fill: Callable[[Figure], None]) -> ReportFigure:
    """Make a figure as wide as a page, which draws itself when it is written."""

    def write(paths: Sequence[Path]) -> None:
        with drawing(width_mm=PAGE_WIDTH_MM, height_mm=height_mm) as figure:
            fill(figure)
            for path in paths:
                save(figure, path)

    return ReportFigure(name, caption, write)


def number(value: float, digits: int = 1) -> str:
    """Write a number; a dash where there is none."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def median(values: FloatArray | None) -> float:
    """Take the median of the numbers that are known; NaN without any."""
    if values is None or not np.isfinite(values).any():
        return math.nan
    return float(np.nanmedian(values))


def utc(stamp_ns: int) -> str:
    """Write an instant to the millisecond, in UTC."""
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(sep=" ", timespec="milliseconds")[:-6]
