"""A report as one HTML file that needs nothing else: figures are inside it. Pure."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from tsgt.analysis.report.verdicts import Level

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.report.verdicts import Verdict

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #111; background: #fff; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.25rem; margin-top: 2.5rem; border-bottom: 1px solid #999; }
nav a { margin-right: 1rem; } a { color: #0050a0; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; font-size: .9rem; }
caption { text-align: left; padding: .3rem 0; } th, td { padding: .2rem .7rem; text-align: right; border-bottom: 1px solid #ccc; }
th:first-child, td:first-child { text-align: left; } thead th { border-bottom: 2px solid #333; }
figure { margin: 1.5rem 0; break-inside: avoid; } img { max-width: 100%; height: auto; } figcaption { color: #333; font-size: .9rem; }
ul.verdicts { list-style: none; padding: 0; } ul.verdicts li { margin: .4rem 0; padding: .3rem .7rem; border-left: 6px solid; }
ul.verdicts li.good { border-color: #009e73; } ul.verdicts li.care { border-color: #e69f00; }
ul.verdicts li.bad { border-color: #000; background: #eee; }
table.facts { border-top: 2px solid #333; } table.facts td { text-align: left; overflow-wrap: anywhere; }
@media print { nav { display: none; } body { max-width: none; margin: 0; } }
"""

_MARK = {
    Level.GOOD: ("good", "\N{CHECK MARK}"),
    Level.CARE: ("care", "!"),
    Level.BAD: ("bad", "\N{MULTIPLICATION SIGN}"),
}


@dataclass(frozen=True, slots=True)
class Table:
    """A table; the first column names the row. Without a header it lists facts, in words."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """A figure.

    Attributes
    ----------
    name
        Of its files, without an ending.
    caption
        What it shows and how to read it.
    write
        Draws it and writes it to files of the given names.
    """

    name: str
    caption: str
    write: Callable[[Sequence[Path]], None]


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a report.

    Attributes
    ----------
    title
        Its heading.
    text
        Paragraphs: what is here, and what is missing and why.
    tables, plots
        What follows them.
    """

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    plots: tuple[ReportFigure, ...] = ()


def render_page(
    title: str,
    facts: Table,
    judged: Sequence[Verdict],
    sections: Sequence[Section],
    images: Mapping[str, bytes],
) -> str:
    """Put a report together.

    Parameters
    ----------
    title
        Of the page.
    facts
        What the recording is.
    judged
        What to trust.
    sections
        What follows.
    images
        PNG files by the names of the plots.
    """
    named = [(f"s{number}", section) for number, section in enumerate(sections, start=1)]
    links = "".join(f'<a href="#{anchor}">{escape(section.title)}</a>' for anchor, section in named)
    trust = "".join(
        f'<li class="{_MARK[v.level][0]}"><strong>{_MARK[v.level][1]} {escape(v.level.value)}:</strong> {_prose(v.text)}</li>'
        for v in judged
    )
    body = "".join(_section(anchor, section, images) for anchor, section in named)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{escape(title)}</h1>\n"
        f"<nav>{links}</nav>\n<h2>Summary</h2>\n{_table(facts)}\n<h3>What to trust</h3>\n"
        f'<ul class="verdicts">{trust}</ul>\n{body}</body>\n</html>\n'
    )


def _section(anchor: str, section: Section, images: Mapping[str, bytes]) -> str:
    text = "".join(f"<p>{_prose(paragraph)}</p>\n" for paragraph in section.text)
    tables = "".join(_table(table) for table in section.tables)
    plots = "".join(_plot(plot, images[plot.name]) for plot in section.plots)
    return f'<h2 id="{anchor}">{escape(section.title)}</h2>\n{text}{tables}{plots}'


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.header)
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in table.rows
    )
    caption = f"<caption>{escape(table.caption)}</caption>" if table.caption else ""
    above = f"<thead><tr>{head}</tr></thead>\n" if table.header else ""
    kind = "" if table.header else ' class="facts"'
    return f"<table{kind}>{caption}{above}<tbody>{rows}</tbody></table>\n"


def _prose(text: str) -> str:
    """Write a sentence; what it has between backticks is what one types."""
    parts = escape(text).split("`")
    return "".join(f"<code>{part}</code>" if i % 2 else part for i, part in enumerate(parts))


def _plot(plot: ReportFigure, image: bytes) -> str:
    data = base64.b64encode(image).decode("ascii")
    return (
        f'<figure><img alt="{escape(plot.name)}" src="data:image/png;base64,{data}">\n'
        f"<figcaption>{escape(plot.caption)} ({plot.name}.pdf)</figcaption></figure>\n"
    )
