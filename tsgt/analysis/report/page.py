"""Content types of a report, formatted values, and its HTML page, which embeds all figures (page.html.j2)."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import PAGE_WIDTH_MM, drawing, save
from tsgt.analysis.report.verdicts import Level
from tsgt.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from tsgt.analysis.report.verdicts import Verdict
    from tsgt.geometry import FloatArray

MAX_LISTED = 20  # Rows of a table that may be long
_MARK = {
    Level.GOOD: ("good", "\N{CHECK MARK}"),
    Level.CARE: ("care", "!"),
    Level.BAD: ("bad", "\N{MULTIPLICATION SIGN}"),
}


@dataclass(frozen=True, slots=True)
class Table:
    """A table; the first column names the row. Without a header it lists facts as text."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """A figure, with the name of its files without a suffix; ``write`` draws it and writes the given files."""

    name: str
    caption: str
    write: Callable[[Sequence[Path]], None]


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a report: paragraphs, tables, then figures."""

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    plots: tuple[ReportFigure, ...] = ()


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


def format_cells(name: str, *values: tuple[float, int]) -> tuple[str, ...]:
    """Format a row of a table: its name, and numbers with their digits."""
    return (name, *(format_number(value, digits) for value, digits in values))


def render_page(
    title: str,
    summary: Table,
    verdicts: Sequence[Verdict],
    sections: Sequence[Section],
    images: Mapping[str, bytes],
) -> str:
    """Render one HTML page without external resources; ``images``: PNG by figure. Raises MissingExtraError without jinja2."""
    try:
        from jinja2 import Environment, StrictUndefined  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise MissingExtraError("reports", library="jinja2", extra="report") from error
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    source = files(__package__).joinpath("page.html.j2").read_text(encoding="utf-8")
    return environment.from_string(source).render(
        title=title,
        summary=summary,
        verdicts=verdicts,
        sections=sections,
        marks=_MARK,
        images={name: base64.b64encode(image).decode("ascii") for name, image in images.items()},
    )
