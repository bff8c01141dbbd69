"""The sections of the report: text, tables and figures on one subject each.

In: ``Findings``. Out: ``Section`` objects for the page, in the order of `document`; `calibration`, `diagnosis` and `imu` also give the
numbers that the report has as JSON.
"""

from tsgt.analysis.report.sections.document import report_sections
from tsgt.analysis.report.sections.trajectories import map_figure

__all__ = ["map_figure", "report_sections"]
