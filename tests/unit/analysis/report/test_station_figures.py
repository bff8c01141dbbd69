"""Report figures contain their data within the axes."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from tsgt.analysis.figures import TimeAxis, drawing
from tsgt.analysis.report import StationRecord
from tsgt.analysis.report.figures.stations import draw_clocks, draw_gaps

SECOND = 1_000_000_000


def record(station: int, first_s: float, last_s: float, bound_ms: float) -> StationRecord:
    """Return measurements twice a second, each timestamp with the same bound."""
    stamps = np.round(np.arange(first_s, last_s + 0.1, 0.5) * SECOND).astype(np.int64)
    return StationRecord(
        station=station,
        prisms=(station,),
        stamp_ns=stamps,
        usable=np.ones(len(stamps), np.bool_),
        bound_ns=np.full(len(stamps), 1e6 * bound_ms),
        delay_s=np.zeros(len(stamps)),
        statuses={"ok": len(stamps)},
        distance_m=(10.0, 20.0),
    )


def test_common_scale_contains_the_bounds_of_all_stations() -> None:
    """Each station has its panel; a scale that fits the first alone would cut the others off."""
    stations = [record(1, 0.0, 9.0, 1.0), record(2, 0.0, 9.0, 0.02), record(3, 0.0, 9.0, 40.0)]
    with drawing(width_mm=100, height_mm=100) as figure:
        draw_clocks(figure, {}, stations, TimeAxis.over(0, 9 * SECOND))
        limits = {panel.get_ylim() for panel in figure.axes}
        assert len(figure.axes) == 3
        assert len(limits) == 1
        low, high = limits.pop()
        assert low < 0.02
        assert high > 40.0


def test_gap_at_the_end_is_drawn() -> None:
    """From the last measurement of a station to the end of all; it is the longest gap in the table."""
    stations = [record(1, 0.0, 20.0, 1.0), record(2, 0.0, 8.0, 1.0)]
    with drawing(width_mm=100, height_mm=100) as figure:
        draw_gaps(figure, stations, TimeAxis.over(0, 20 * SECOND), 1.0, 20 * SECOND)
        marks = [
            [line.get_xydata() for line in panel.lines if line.get_label() == "gap at start or end"]
            for panel in figure.axes
        ]
        assert marks[0] == []
        assert np.asarray(marks[1][0]).tolist() == [[20.0, 12.0]]
        assert figure.axes[1].get_ylim()[1] > 12.0
