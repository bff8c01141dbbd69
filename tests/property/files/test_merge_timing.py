"""Times of merged measurements are within their bound for any clock within the stated model."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from harness.clocks.clock_exchanges import SECOND, START_NS, exchange
from hypothesis import given, settings
from hypothesis import strategies as st

from tsgt.analysis.merge.timing import times_from_synchronisations

MS = 1_000_000
LARGEST_SWING_PPM = 10.0


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    ppm=st.floats(-60, 60),
    wander_ppm_per_s=st.floats(0, 0.005),
    late_share=st.floats(0, 0.3),
    late_ms=st.floats(0, 5),
    cycles=st.integers(1, 50),
    loss=st.floats(0, 0.3),
    gaps_s=st.lists(st.sampled_from([30.0, 60.0, 180.0, 300.0, 600.0, 5400.0]), min_size=1, max_size=15),
)
def test_bound_contains_the_truth(
    seed: int,
    ppm: float,
    wander_ppm_per_s: float,
    late_share: float,
    late_ms: float,
    cycles: int,
    loss: float,
    gaps_s: list[float],
) -> None:
    """Random drift, temperature waves, delays, losses and outages; before, between and after synchronisations."""
    rng = np.random.default_rng(seed)
    period_s, phase = rng.uniform(1200, 7200), rng.uniform(0, 2 * math.pi)
    # Frequency is a wave whose steepest slope is the wander.
    rate = 2 * math.pi / period_s
    swing_ppm = min(wander_ppm_per_s / rate, LARGEST_SWING_PPM)

    def offset_ns(true_ns: float) -> float:
        t = true_ns / 1e9
        return 1e3 * (ppm * t + swing_ppm / rate * (math.cos(phase) - math.cos(rate * t + phase)))

    starts_s = np.cumsum([100.0, *gaps_s]).tolist()
    synchronisations = []
    for number, start_s in enumerate(starts_s):
        samples = [
            exchange(
                round((start_s + 0.24 * cycle) * SECOND),
                offset_ns,
                late_ns=round(rng.normal(0, 5_000))
                + (round(rng.exponential(late_ms * MS)) if rng.random() < late_share else 0),
                turnaround_ns=round(rng.uniform(1, 8) * MS),
            )
            for cycle in range(cycles if number == 0 else 5)
            if rng.random() >= loss
        ]
        if samples:
            synchronisations.append(samples)
    if not synchronisations:
        return
    truths_ns = [
        round(time_s * SECOND)
        for before_s, after_s in pairwise([0.0, *starts_s, starts_s[-1] + 600.0])
        for time_s in np.linspace(before_s, after_s, 9).tolist()
    ]
    stamps_ns = [START_NS + true_ns + round(offset_ns(true_ns)) for true_ns in truths_ns]
    found = times_from_synchronisations(synchronisations, stamps_ns)
    for true_ns, time in zip(truths_ns, found, strict=True):
        assert time is not None
        assert abs(time.unix_ns - START_NS - true_ns) <= time.bound_ns
