"""Report of a comparison: estimates side by side, map, errors over time and distance, and what each fitted quantity hides.

Comes in: comparisons of estimates with the reference. Goes out: headline, map and sections for the page of ``report``.
"""

from tsgt.analysis.comparison_report.headline import comparison_headline
from tsgt.analysis.comparison_report.notes import notes
from tsgt.analysis.comparison_report.sections import comparison_map, comparison_sections

__all__ = ["comparison_headline", "comparison_map", "comparison_sections", "notes"]
