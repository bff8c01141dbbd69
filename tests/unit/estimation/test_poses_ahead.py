"""Poses of the next epochs, computed together."""

from __future__ import annotations

import numpy as np
from harness.prior_motion import draw_motions, measure, sorted_by_time
from harness.scene import stationary_scene

from tsgt.estimation import ContinuousPoseOutput
from tsgt.estimation.poses_ahead import PosesAhead
from tsgt.geometry.trajectory import FixedLagSmoother
from tsgt.model import MotionPrior

PERIOD_NS, ORIGIN_NS = 50_000_000, 1_800_000_000_000_000_000
AGES_NS = [1_000_000_000, 300_000_000, 0]


def test_poses_are_those_of_each_epoch_alone() -> None:
    """To the bit, whatever was computed ahead, and whenever the trajectory changes; also beyond its last measurement."""
    motion = draw_motions(MotionPrior(), count=1, duration_s=3.0, seed=1)[0]
    observations = sorted_by_time(measure(motion, until_s=3.0, seed=2))
    output = ContinuousPoseOutput(stationary_scene().parameters)
    smoothers = [FixedLagSmoother(MotionPrior()) for _ in range(2)]
    ahead = PosesAhead(smoothers[0], output, PERIOD_NS)
    added, compared = 0, 0
    for number in range(20, 58):
        time_s = number * PERIOD_NS / 1e9
        now = int(np.searchsorted(observations.time_s, time_s))
        if now - added >= 4:  # one after the other
            for smoother in smoothers:
                smoother.update(observations.select(slice(added, now)))
            added = now
        if number % 10 == 0:
            for smoother in smoothers:
                smoother.marginalise_before(time_s - 1.6)
        if not smoothers[0].converged:
            continue
        found = ahead.due(ORIGIN_NS + number * PERIOD_NS, AGES_NS, ORIGIN_NS)
        times_s = (number * PERIOD_NS - np.array(AGES_NS)) / 1e9
        expected = [
            output.numbers(*smoothers[1].smoothed_trajectory().at(times_s[:-1], dim=6)),
            output.numbers(*smoothers[1].predict(float(times_s[-1]), dim=6)),
        ]
        for values, *parts in zip(found, *expected, strict=True):
            np.testing.assert_array_equal(values, np.concatenate(parts))
        compared += 1
    assert compared > 20
