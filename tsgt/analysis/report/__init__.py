"""TODO face."""

from tsgt.analysis.report.findings import Difference, Findings, collect_findings
from tsgt.analysis.report.log import ClockSeries, RadioSeries
from tsgt.analysis.report.motion import Bins, DistanceErrorSeries, Grid
from tsgt.analysis.report.numbers import report_numbers
from tsgt.analysis.report.page import render_page
from tsgt.analysis.report.sections import facts, sections
from tsgt.analysis.report.stations import StationRecord
from tsgt.analysis.report.verdicts import verdicts

__all__ = [
    "Bins",
    "ClockSeries",
    "Difference",
    "DistanceErrorSeries",
    "Findings",
    "Grid",
    "RadioSeries",
    "StationRecord",
    "collect_findings",
    "facts",
    "render_page",
    "report_numbers",
    "sections",
    "verdicts",
]
