"""Tables of a report on the reference, besides the unaligned errors: what an alignment hides, and the stops. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.report_page import Table
from tsgt.analysis.report_parts import number

if TYPE_CHECKING:
    from tsgt.analysis.report import Findings


def reference_tables(f: Findings) -> list[Table]:
    """Make a table of the aligned errors if they were asked for, and one of the stops if there are any."""
    tables = []
    if f.aligned:
        rows = [
            (
                name,
                number(a.position_rms_mm),
                number(a.orientation_rms_deg, 3),
                number(a.translation_mm),
                number(a.rotation_deg, 3),
                number(a.hidden_position_mm),
                number(a.hidden_orientation_deg, 3),
            )
            for name, a in f.aligned.items()
        ]
        header = (
            *("estimator", "rms (mm)", "rms (deg)", "shifted (mm)", "turned (deg)"),
            *("hides (mm)", "hides (deg)"),
        )
        tables.append(
            Table(
                "The same aligned: what is left, what was removed, and how much of the rms that hides",
                header,
                tuple(rows),
            )
        )
    stops = [
        (
            name,
            str(s.stops),
            number(s.position_mean_mm, 2),
            number(s.position_max_mm, 2),
            number(s.rotation_mean_deg, 3),
            number(s.rotation_max_deg, 3),
        )
        for name, s in f.stops.items()
        if s.stops
    ]
    if stops:
        tables.append(
            Table(
                "The mean pose of each stop against the reference, unaligned",
                ("estimator", "stops", "mean (mm)", "largest (mm)", "mean (deg)", "largest (deg)"),
                tuple(stops),
            )
        )
    return tables
