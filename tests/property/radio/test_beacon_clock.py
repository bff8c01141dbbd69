"""The beacon clock's bound contains the truth for any clock within the stated model."""

from __future__ import annotations

import math

import numpy as np
import pytest
from harness.clocks.beacon_scenarios import BeaconScenario, run_beacon_scenario
from hypothesis import given, settings
from hypothesis import strategies as st


@settings(max_examples=150)
@given(
    seed=st.integers(0, 2**32 - 1),
    drift_ppm=st.floats(-100, 100),
    ramp_ppm_per_min=st.floats(-2, 2),
    wander_ppm=st.floats(0, 0.3),
    changes=st.integers(0, 20),
    outage_s=st.sampled_from([0, 1, 10, 60, 600]),
    stamp_sigma_us=st.floats(3, 1000),
    understated=st.floats(0.3, 1),
    loss=st.floats(0, 0.5),
    frame_s=st.floats(0.3, 3),
    duration_s=st.sampled_from([5, 20, 60]),
)
@pytest.mark.slow
def test_bound_contains_the_truth(
    seed: int,
    drift_ppm: float,
    ramp_ppm_per_min: float,
    wander_ppm: float,
    changes: int,
    outage_s: int,
    stamp_sigma_us: float,
    understated: float,
    loss: float,
    frame_s: float,
    duration_s: int,
) -> None:
    """For any skew, ramp, changes by up to 20 ppm, outage, understated timestamps and few samples."""
    rng = np.random.default_rng(seed)
    levels_ppm = np.concatenate([[0.0], rng.uniform(-10, 10, changes)])
    times_s = np.sort(rng.uniform(0, duration_s + outage_s, changes)) // 15 * 15 + rng.uniform(0, 1)
    start_s = float(rng.uniform(0, duration_s))
    run = run_beacon_scenario(
        BeaconScenario(
            name="any",
            drift_ppm=drift_ppm,
            ramp_ppm_per_min=ramp_ppm_per_min,
            wander_ppm=wander_ppm,
            changes_ppm=tuple(zip(times_s.tolist(), np.diff(levels_ppm).tolist(), strict=True)),
            outages_s=((start_s, start_s + outage_s),),
            stamp_sigma_us=stamp_sigma_us,
            stated_sigma_us=max(stamp_sigma_us * understated, 1.0),
            loss=loss,
            frame_s=frame_s,
            duration_s=duration_s + outage_s,
        ),
        seed=math.floor(rng.integers(2**32)),
    )
    assert all(abs(time.error_us) <= time.bound_us for time in run.times)
