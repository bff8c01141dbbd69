"""Knots that measurements share."""

from __future__ import annotations

import numpy as np

from tsgt.geometry.batch import shared_knot_times
from tsgt.geometry.batch.knots import KNOT_SPAN_S
from tsgt.geometry.trajectory import nearest_knots


def test_measurements_within_a_span_share_a_knot() -> None:
    """In the middle of their times; a single one has its own time."""
    times_s = np.array([1.0, 1.03, 1.1, 1.3, 2.0, 2.0])
    np.testing.assert_allclose(shared_knot_times(times_s), [1.05, 1.3, 2.0])


def test_knots_are_near_and_apart() -> None:
    """However measurements lie, a knot is within half a span of each, and half a span from the next knot."""
    times_s = np.sort(np.random.default_rng(1).uniform(0.0, 20.0, 1000))
    knots_s = shared_knot_times(times_s)
    assert np.abs(knots_s[nearest_knots(knots_s, times_s)] - times_s).max() <= KNOT_SPAN_S / 2 + 1e-12
    assert np.diff(knots_s).min() >= KNOT_SPAN_S / 2 - 1e-12
