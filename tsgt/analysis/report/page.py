"""Content types of a report and its HTML page, which embeds all figures. The template is page.html.j2. Sans-I/O."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING

from tsgt.analysis.report.verdicts import Level
from tsgt.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.report.verdicts import Verdict

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
    """A figure.

    Attributes
    ----------
    name
        Of its files, without a suffix.
    write
        Draws the figure and writes it to the given files.
    """

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


def render_page(
    title: str,
    summary: Table,
    verdicts: Sequence[Verdict],
    sections: Sequence[Section],
    images: Mapping[str, bytes],
) -> str:
    """Render a report as one HTML page without external resources; ``images`` holds PNG files by name of the figure.

    Raises
    ------
    MissingExtraError
        jinja2 is not installed.
    """
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
