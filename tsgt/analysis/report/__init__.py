"""Report of a recording: one HTML page with verdicts, tables and figures, and the same numbers as JSON.

Comes in: a recording, perhaps a reference trajectory and stationary intervals. Goes out: ``Findings``, and from them
verdicts, sections, page and numbers. matplotlib and jinja2 are imported when a figure or page is made.
"""

from tsgt.analysis.report.findings import Findings, collect_findings
from tsgt.analysis.report.headline import headline
from tsgt.analysis.report.numbers import report_numbers
from tsgt.analysis.report.page import Headline, Images, render_page
from tsgt.analysis.report.sections import sections
from tsgt.analysis.report.stations import StationRecord
from tsgt.analysis.report.trajectory_sections import map_figure
from tsgt.analysis.report.verdicts import verdicts

__all__ = [
    "Findings",
    "Headline",
    "Images",
    "StationRecord",
    "collect_findings",
    "headline",
    "map_figure",
    "render_page",
    "report_numbers",
    "sections",
    "verdicts",
]
