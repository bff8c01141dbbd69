"""Smoothed states of the next epochs, computed together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from harness.prior_motion import draw_motions, measure, sorted_by_time

from tsgt.estimation.smoothed_ahead import SmoothedAhead
from tsgt.geometry.trajectory import States, Trajectory, initial_guess, knot_times, solve
from tsgt.model import MotionPrior

PERIOD_NS, ORIGIN_NS = 50_000_000, 1_800_000_000_000_000_000
DELAYS_NS = (1_000_000_000, 300_000_000)


def test_states_are_those_of_the_trajectory_at_the_time() -> None:
    """To the bit, whatever was computed ahead, and whenever the trajectory changes; also beyond its last knot."""
    prior = MotionPrior()
    motion = draw_motions(prior, count=1, duration_s=3.0, seed=1)[0]
    observations = sorted_by_time(measure(motion, until_s=2.0, seed=2))
    found = solve(observations, initial_guess(observations, knot_times(observations.time_s)), prior)
    covariances = found.factor.marginals()
    fitted = Trajectory(found.knots, prior, *covariances)
    common = replace(fitted, common=(0.5 * covariances[0], 0.5 * covariances[1]))
    ahead = SmoothedAhead(PERIOD_NS, dim=6)
    successive = [fitted] * 5 + [common] * 5 + [replace(common)] * 3 + [fitted] * 7
    for epoch, trajectory in enumerate(successive, start=25):
        stamps_ns = [ORIGIN_NS + epoch * PERIOD_NS - delay_ns for delay_ns in DELAYS_NS]
        states, covariance, shared = ahead.at(trajectory, stamps_ns, ORIGIN_NS)
        time_s = (np.array(stamps_ns) - ORIGIN_NS) / 1e9
        expected, expected_covariance = trajectory.at(time_s, dim=6)
        for name in States.__slots__:
            np.testing.assert_array_equal(getattr(states, name), getattr(expected, name))
        np.testing.assert_array_equal(covariance, expected_covariance)
        np.testing.assert_equal(shared, trajectory.common_at(time_s, dim=6))
