"""Report of a recording: one HTML page with verdicts, tables and figures, and the same numbers as JSON.

Comes in: a recording, perhaps a reference trajectory and stationary intervals. Goes out: ``Findings``, and from them
verdicts, sections, page and numbers. matplotlib and jinja2 are imported when a figure or page is made.
"""

from tsgt.analysis.report.findings import Findings, collect_findings
from tsgt.analysis.report.numbers import report_numbers
from tsgt.analysis.report.page import render_page
from tsgt.analysis.report.sections import sections, summary_table
from tsgt.analysis.report.stations import StationRecord
from tsgt.analysis.report.verdicts import verdicts

__all__ = [
    "Findings",
    "StationRecord",
    "collect_findings",
    "render_page",
    "report_numbers",
    "sections",
    "summary_table",
    "verdicts",
]
