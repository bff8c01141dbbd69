"""A search that ends in a local minimum is repeated from coarse noise."""

from __future__ import annotations

import pytest
from harness.drives.field_day import START_NS, calibrated, field_day

from tsgt.estimation import build_observations
from tsgt.geometry.trajectory import initial_guess, knot_times, solve
from tsgt.model import MotionPrior


@pytest.mark.slow
def test_outage_of_a_prism_in_a_bend_leaves_no_outliers() -> None:
    """Across 12 s with two prisms the guess of the rotation is far off, but no good measurement is rejected."""
    recording = calibrated(field_day([], 1, duration_s=240.0))
    observations, _ = build_observations(recording.parameters, recording.measurements, origin_ns=START_NS)
    time_s = observations.time_s
    out = (observations.station == 1) & (time_s > 55.0) & (time_s < 67.0)
    some = observations.select((time_s > 40.0) & (time_s < 85.0) & ~out)
    solution = solve(some, initial_guess(some, knot_times(some.time_s)), MotionPrior())
    assert solution.squared_distances.max() < 30.0
