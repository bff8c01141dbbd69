from __future__ import annotations

import numpy as np
import pytest
from harness.drives.scene import SECOND, START

from tsgt.analysis.figures import TimeAxis
from tsgt.analysis.figures.axes import BUCKETS, thinned


def test_thinned_curve_keeps_peaks_and_gaps() -> None:
    """It looks the same on paper."""
    x = np.arange(100_000.0)
    y = np.sin(x / 5000)
    y[12_345], y[50_000:60_000] = 7.0, np.nan
    some_x, some_y = thinned(x, y)
    assert len(some_x) < 3 * BUCKETS
    assert np.nanmax(some_y) == 7.0
    assert np.isnan(some_y[(some_x > 50_200) & (some_x < 59_800)]).all()
    assert (np.diff(some_x) >= 0).all()


@pytest.mark.parametrize(("span_s", "unit"), [(100, "(s)"), (3600, "(min)"), (40_000, "(h)")])
def test_time_axis_has_small_numbers(span_s: int, unit: str) -> None:
    """Its unit depends on the duration of the recording."""
    axis = TimeAxis.over(START, START + span_s * SECOND)
    assert axis.label.endswith(unit)
    assert float(axis.of(START + span_s * SECOND)) <= 300
