"""Report of a recording: one HTML page with verdicts, tables and figures, and the same numbers as JSON.

Comes in: a recording, perhaps a reference trajectory and stationary intervals. Goes out: ``Findings``, and from them
verdicts, sections, page and numbers. matplotlib and jinja2 are imported when a figure or page is made.
"""

from tsgt.analysis.report.findings import Findings, collect_findings
from tsgt.analysis.report.log import read_log
from tsgt.analysis.report.motion import distance_error_series
from tsgt.analysis.report.numbers import report_numbers
from tsgt.analysis.report.page import render_page
from tsgt.analysis.report.sections import sections, summary_table
from tsgt.analysis.report.stations import StationRecord, station_records, station_statistics
from tsgt.analysis.report.verdicts import Verdict, verdicts

__all__ = [
    "Findings",
    "StationRecord",
    "Verdict",
    "collect_findings",
    "distance_error_series",
    "read_log",
    "render_page",
    "report_numbers",
    "sections",
    "station_records",
    "station_statistics",
    "summary_table",
    "verdicts",
]
