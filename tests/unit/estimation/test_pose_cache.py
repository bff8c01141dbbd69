"""Poses of the next epochs, computed together."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from harness.drives.prior_motion import draw_motions, measure, sorted_by_time
from harness.drives.scene import stationary_scene

from tsgt.estimation import ContinuousPoseOutput
from tsgt.estimation.pose_cache import EPOCHS, PoseCache, SmoothedStateCache
from tsgt.geometry.trajectory import FixedLagSmoother, States
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

PERIOD_NS, ORIGIN_NS = 50_000_000, 1_800_000_000_000_000_000
AGES_NS = [1_000_000_000, 300_000_000, 0]


def test_poses_are_those_of_each_epoch_alone() -> None:
    """To the bit, whatever was computed ahead, and whenever the trajectory changes; also beyond its last measurement."""
    motion = draw_motions(MotionPrior(), count=1, duration_s=3.0, seed=1)[0]
    observations = sorted_by_time(measure(motion, until_s=3.0, seed=2))
    output = ContinuousPoseOutput(stationary_scene().parameters)
    smoothers = [FixedLagSmoother(MotionPrior()) for _ in range(2)]
    ahead = PoseCache(smoothers[0], output, PERIOD_NS)
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


@dataclass
class Line:
    """A trajectory along a line, settled up to a time."""

    unchanged_until_s: float
    speed_mps: float = 1.0
    asked: list[int] = field(default_factory=list)  # Number of times in each query

    def at(self, time_s: FloatArray, *, dim: int = 6) -> tuple[States, FloatArray]:
        """Return the states."""
        self.asked.append(len(time_s))
        zero = np.zeros((len(time_s), 3))
        position = zero + self.speed_mps * time_s[:, None]
        rotation = np.tile(np.eye(3), (len(time_s), 1, 1))
        states = States(time_s, position, rotation, zero, zero, zero, zero)
        return states, np.tile(np.eye(dim), (len(time_s), 1, 1))

    def common_at(self, time_s: FloatArray, *, dim: int = 6) -> FloatArray | None:  # noqa: ARG002 (as asked)
        """Return that it is unknown."""
        return None


def positions(ahead: SmoothedStateCache, line: Line, stamps_ns: list[int]) -> list[float]:
    """Return the position at epochs."""
    states, covariance, _ = ahead.at(line, [ORIGIN_NS + each for each in stamps_ns], ORIGIN_NS)
    assert len(covariance) == len(stamps_ns)
    return [float(each) for each in states.position[:, 0]]


def test_smoothed_states_of_several_epochs_are_computed_together() -> None:
    """Until there is another trajectory; those of two ages in any order."""
    ahead, line = SmoothedStateCache(PERIOD_NS), Line(10.0)
    for number in range(2 * EPOCHS):
        found = positions(ahead, line, [(20 + number) * PERIOD_NS, (40 + number) * PERIOD_NS])
        np.testing.assert_allclose(found, [1.0 + 0.05 * number, 2.0 + 0.05 * number])
    assert line.asked == [2 * EPOCHS, 2 * EPOCHS]
    faster = Line(10.0, speed_mps=2.0)
    assert positions(ahead, faster, [40 * PERIOD_NS]) == [4.0]


def test_states_that_later_samples_change_are_not_kept() -> None:
    """The same epoch beyond the newest knot, asked for again."""
    ahead, line = SmoothedStateCache(PERIOD_NS), Line(1.0)
    assert positions(ahead, line, [19 * PERIOD_NS]) == [0.95]
    assert line.asked == [2]  # 0.95 and 1.0
    assert positions(ahead, line, [21 * PERIOD_NS]) == [1.05]
    line.speed_mps = 2.0
    assert positions(ahead, line, [21 * PERIOD_NS]) == [2.1]
