"""Errors of the beacon clock in each scenario."""

from __future__ import annotations

from functools import cache

import pytest
from harness.clocks.beacon_scenarios import BEACON_SCENARIOS, BeaconScenario, run_beacon_scenario

BY_NAME = {scenario.name: scenario for scenario in BEACON_SCENARIOS}
CONVERGED_S = 5.0
UNPREDICTABLE = {"slewed"}

known_run = cache(run_beacon_scenario)


@pytest.mark.parametrize("name", sorted(set(BY_NAME) - UNPREDICTABLE))
@pytest.mark.slow
def test_bound_contains_the_truth(name: str) -> None:
    """Every reported time is within its bound."""
    for seed in range(3):
        assert max(abs(t.error_us) / t.bound_us for t in known_run(BY_NAME[name], seed).times) < 1


@pytest.mark.parametrize(
    "name", ["usual", "loss", "outage", "long-outage", "steps", "exact", "late", "delayed", "slewed"]
)
@pytest.mark.slow
def test_live_times_are_accurate_to_microseconds(name: str) -> None:
    """Including rounding to 16 us: p50 at most 11 us, p99 at most 40 us."""
    for seed in range(3):
        run = known_run(BY_NAME[name], seed)
        assert run.quantile_us(0.5, live=True, since_s=CONVERGED_S) < 11
        assert run.quantile_us(0.99, live=True, since_s=CONVERGED_S) < (75 if name == "slewed" else 40)


@pytest.mark.slow
def test_outage_is_smoothed_from_both_sides() -> None:
    """Times within 60 s without a beacon are accurate to 75 us."""
    for seed in range(5):
        assert known_run(BY_NAME["outage"], seed).quantile_us(0.99, live=False) < 75


def test_bounds_usually_allow_the_short_reply() -> None:
    """A reply of the form ``single`` claims 128 us."""
    bounds_us = [t.bound_us for t in known_run(BY_NAME["usual"]).times if t.measured_s >= CONVERGED_S]
    assert sum(bound_us <= 128 for bound_us in bounds_us) > 0.97 * len(bounds_us)


def test_slewed_clock_violates_the_bound_for_two_frames_only() -> None:
    """A change of 500 ppm is unobservable before the next sample; from then on the bound holds."""
    for seed in range(5):
        broken_s = [
            t.measured_s for t in known_run(BY_NAME["slewed"], seed).times if abs(t.error_us) > t.bound_us
        ]
        assert all(300 <= at_s < 301.2 or 320 <= at_s < 321.2 for at_s in broken_s)


def test_delayed_beacons_are_rejected() -> None:
    """All delayed beacons are rejected, and no others."""
    run = known_run(BY_NAME["delayed"])
    assert run.rejected == len(BY_NAME["delayed"].delayed_s)
    assert known_run(BY_NAME["usual"]).rejected == 0


def test_same_seed_gives_the_same_run() -> None:
    """Another seed gives another run."""
    scenario = BeaconScenario(name="short", loss=0.3, wander_ppm=0.1, duration_s=20)
    assert run_beacon_scenario(scenario, 1) == run_beacon_scenario(scenario, 1)
    assert run_beacon_scenario(scenario, 1) != run_beacon_scenario(scenario, 2)
