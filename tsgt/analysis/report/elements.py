"""Elements of report sections: figures of page width, formatted numbers and times."""

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

MAX_LISTED = 20
"""Rows of a table that may be long."""


def page_figure(name: str, caption: str, height_mm: float, fill: Callable[[Figure], None]) -> ReportFigure:
    """Return a figure of page width that ``fill`` draws when it is written."""

    def write(paths: Sequence[Path]) -> None:
        with drawing(width_mm=PAGE_WIDTH_MM, height_mm=height_mm) as figure:
            fill(figure)
            for path in paths:
                save(figure, path)

    return ReportFigure(name, caption, write)


def format_number(value: float, digits: int = 1) -> str:
    """Format a number; a dash for NaN."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def nan_median(values: FloatArray | None) -> float:
    """Return the median of the finite values; NaN without any."""
    if values is None or not np.isfinite(values).any():
        return math.nan
    return float(np.nanmedian(values))


def format_utc(stamp_ns: int) -> str:
    """Format a Unix time to the millisecond, in UTC."""
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(sep=" ", timespec="milliseconds")[:-6]
