"""Report of a recording: one HTML page with verdicts, tables and figures, and the same numbers as JSON.

Comes in: a recording, perhaps a reference trajectory and stationary intervals. Goes out: ``Findings``, and from them
verdicts, sections, page and numbers. matplotlib and jinja2 are imported when a figure or page is made.
"""

from tsgt.analysis.report.findings import Findings, collect_findings
from tsgt.analysis.report.headline import headline
from tsgt.analysis.report.numbers import report_numbers
from tsgt.analysis.report.page import (
    MAX_LISTED,
    Headline,
    Images,
    ReportFigure,
    Section,
    Table,
    format_cells,
    format_number,
    format_share,
    format_utc,
    render_page,
)
from tsgt.analysis.report.sections.document import report_sections
from tsgt.analysis.report.sections.trajectories import map_figure
from tsgt.analysis.report.stations import StationRecord
from tsgt.analysis.report.verdicts import verdicts

__all__ = [
    "MAX_LISTED",
    "Findings",
    "Headline",
    "Images",
    "ReportFigure",
    "Section",
    "StationRecord",
    "Table",
    "collect_findings",
    "format_cells",
    "format_number",
    "format_share",
    "format_utc",
    "headline",
    "map_figure",
    "render_page",
    "report_numbers",
    "report_sections",
    "verdicts",
]
