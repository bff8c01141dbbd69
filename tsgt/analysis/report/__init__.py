"""TODO face."""

from tsgt.analysis.report.findings import Difference, Findings, find
from tsgt.analysis.report.log import ClockSeries, RadioSeries
from tsgt.analysis.report.motion import Bins, Grid, Ride
from tsgt.analysis.report.numbers import figures_of
from tsgt.analysis.report.page import page
from tsgt.analysis.report.sections import facts, sections
from tsgt.analysis.report.stations import StationRecord
from tsgt.analysis.report.verdicts import verdicts

__all__ = [
    "Bins",
    "ClockSeries",
    "Difference",
    "Findings",
    "Grid",
    "RadioSeries",
    "Ride",
    "StationRecord",
    "facts",
    "figures_of",
    "find",
    "page",
    "sections",
    "verdicts",
]
