from __future__ import annotations

import numpy as np
import pytest
from harness.scene import SECOND, START

from tsgt.analysis.figures import TimeAxis
from tsgt.analysis.figures.axes import BUCKETS, thinned


def test_a_long_curve_keeps_its_peaks_and_its_gaps() -> None:
    """Thinned, it looks the same on paper."""
    x = np.arange(100_000.0)
    y = np.sin(x / 5000)
    y[12_345], y[50_000:60_000] = 7.0, np.nan
    some_x, some_y = thinned(x, y)
    assert len(some_x) < 3 * BUCKETS
    assert np.nanmax(some_y) == 7.0
    assert np.isnan(some_y[(some_x > 50_200) & (some_x < 59_800)]).all()
    assert (np.diff(some_x) >= 0).all()


@pytest.mark.parametrize(("span_s", "unit"), [(100, "(s)"), (3600, "(min)"), (40_000, "(h)")])
def test_the_axis_of_time_has_small_numbers(span_s: int, unit: str) -> None:
    """Its unit follows from how long the recording is."""
    clock = TimeAxis.over(START, START + span_s * SECOND)
    assert clock.label.endswith(unit)
    assert float(clock.of(START + span_s * SECOND)) <= 300
