"""Knot times of a whole recording. Sans-I/O."""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray

KNOT_SPAN_S = 0.12
"""Measurements within this share a knot. A constant acceleration describes the motion up to half of it away; the jerk that it
leaves out displaces the robot by 0.1 mm, a tenth of an instrument's noise at the most. Three stations at 2.5 Hz need two thirds of
the knots that one for each measurement would be.
"""


def shared_knot_times(time_s: FloatArray) -> FloatArray:
    """Choose knot times for measurements at times ``time_s``, (M,), in increasing order: few, all at least half a span apart."""
    times_s, knots_s, first = time_s.tolist(), [], 0
    while first < len(times_s):
        after = bisect_right(times_s, times_s[first] + KNOT_SPAN_S, first)
        # A single measurement has its knot exactly at its time.
        knots_s.append(0.5 * (times_s[first] + times_s[after - 1]))
        first = after
    return np.array(knots_s)
