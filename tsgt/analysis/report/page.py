"""Content types of a report, formatted values, and its HTML page, which embeds all figures (page.html.j2)."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.analysis.figures import PAGE_WIDTH_MM, drawing, png_bytes, save
from tsgt.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from tsgt.geometry import FloatArray

MAX_LISTED = 20  # Rows of a table that may be long
COLUMN_WIDTH_MM = 90.0  # One column of most journals: on a telephone its text is legible
UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Headline:
    """``key_figures`` (name, value) and three lists of sentences, in which `...` is a command: the verdicts, and their repairs."""

    key_figures: tuple[tuple[str, str], ...]
    trust: tuple[str, ...]
    caution: tuple[str, ...]
    repairs: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """A table; the first column names the row. Without a header it lists facts: names and values."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """A figure: name of its files without a suffix, title, caption, height, and the function that draws it at any width."""

    name: str
    title: str
    caption: str
    height_mm: float
    fill: Callable[[Figure], None]
    narrow_height_mm: float | None = None  # None: the same

    def write(self, paths: Sequence[Path]) -> None:
        """Draw it at page width and write the given files."""
        with drawing(width_mm=PAGE_WIDTH_MM, height_mm=self.height_mm) as figure:
            self.fill(figure)
            for path in paths:
                save(figure, path)

    def narrow_png(self) -> bytes:
        """Draw it for a narrow screen."""
        height_mm = self.height_mm if self.narrow_height_mm is None else self.narrow_height_mm
        with drawing(width_mm=COLUMN_WIDTH_MM, height_mm=height_mm) as figure:
            self.fill(figure)
            return png_bytes(figure)


class Images(NamedTuple):
    """PNG images of a figure for a wide and for a narrow screen."""

    wide: bytes
    narrow: bytes


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a report: paragraphs, tables, then figures."""

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    plots: tuple[ReportFigure, ...] = ()


def format_number(value: float, digits: int = 1) -> str:
    """Format a number; ``unknown`` for NaN."""
    return f"{value:.{digits}f}" if math.isfinite(value) else UNKNOWN


def format_share(value: float, digits: int = 1) -> str:
    """Format a share, 0 to 1, in percent; ``unknown`` for NaN."""
    return f"{value:.{digits}%}" if math.isfinite(value) else UNKNOWN


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
    headline: Headline,
    path_map: ReportFigure | None,
    sections: Sequence[Section],
    images: Mapping[str, Images],
) -> str:
    """Render one HTML page without external resources; ``images``: by figure. Raises MissingExtraError without jinja2."""
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
        key_figures=headline.key_figures,
        headline=(
            ("good", "\N{CHECK MARK}", "What to trust", headline.trust or ("Nothing yet.",)),
            ("care", "!", "What not to trust", headline.caution or ("No objection was found.",)),
            ("todo", "\N{RIGHTWARDS ARROW}", "What to do", headline.repairs or ("Nothing.",)),
        ),
        map=path_map,
        sections=sections,
        images={
            name: [base64.b64encode(image).decode("ascii") for image in each] for name, each in images.items()
        },
    )
