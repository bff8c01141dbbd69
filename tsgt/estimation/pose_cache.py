"""Cache of poses of the next epochs, computed together. Sans-I/O.

Live, a few epochs pass between two measurements, and nothing changes meanwhile. Poses of several epochs cost little more than
those of one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory import POSE_DIM, concatenate_states

if TYPE_CHECKING:
    from tsgt.estimation.pose_output import ContinuousPoseOutput, PoseNumbers
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import FixedLagSmoother, Predictions, QueriedTrajectory, States

EPOCHS = 3  # Seven measurements a second come for 20 epochs a second


class PoseCache:
    """Poses of a fixed-lag smoother at epochs, which are multiples of a period; the same bits as of each epoch alone."""

    def __init__(self, smoother: FixedLagSmoother, output: ContinuousPoseOutput, period_ns: int) -> None:
        self._smoother, self._output, self._period_ns = smoother, output, period_ns
        self._revision: int | None = None
        self._rows: dict[tuple[int, int], int] = {}  # By epoch, and how much later its pose is sent
        self._numbers: PoseNumbers | None = None
        self._predictions: Predictions | None = None

    def due(self, epoch_ns: int, ages_ns: list[int], origin_ns: int) -> PoseNumbers:
        """Return the poses that are sent at an epoch, in the order of their ages: smoothed, and last the predicted one of age 0.

        ``origin_ns``: origin of the trajectory's times.
        """
        keys = [(epoch_ns, age_ns) for age_ns in ages_ns]
        if self._revision != self._smoother.revision or any(key not in self._rows for key in keys):
            self._compute(epoch_ns, ages_ns, origin_ns)
        assert self._numbers is not None  # noqa: S101 (computed above)
        assert self._predictions is not None  # noqa: S101 (computed above)
        rows = [self._rows[key] for key in keys]
        self._smoother.record(self._predictions, rows[-1])
        return self._numbers.select(rows)

    def _compute(self, epoch_ns: int, ages_ns: list[int], origin_ns: int) -> None:
        epochs_ns = [epoch_ns + i * self._period_ns for i in range(EPOCHS)]
        *smoothed_ages_ns, _ = ages_ns
        smoothed = [(each_ns, age_ns) for age_ns in smoothed_ages_ns for each_ns in epochs_ns]
        predicted = [(each_ns, 0) for each_ns in epochs_ns]
        time_s = _times_s(predicted, origin_ns)
        found = self._predictions = self._smoother.predictions(time_s, dim=POSE_DIM)
        states, covariance = found.states, found.covariance
        common = self._smoother.predictions_common(time_s, dim=POSE_DIM)
        if smoothed:
            trajectory, time_s = self._smoother.smoothed_trajectory(), _times_s(smoothed, origin_ns)
            some, some_covariance = trajectory.at(time_s, dim=POSE_DIM)
            states = concatenate_states([states, some])
            covariance = np.concatenate([covariance, some_covariance])
            some_common = trajectory.common_at(time_s, dim=POSE_DIM)
            if common is not None and some_common is not None:
                common = np.concatenate([common, some_common])
        self._numbers = self._output.numbers(states, covariance, common)
        self._rows = {key: row for row, key in enumerate([*predicted, *smoothed])}
        self._revision = self._smoother.revision


class SmoothedStateCache:
    """Smoothed states of any window at epochs, which are multiples of a period; new ones for each trajectory."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._trajectory: QueriedTrajectory | None = None
        self._rows: dict[int, int] = {}  # By epoch
        self._found: tuple[States, FloatArray, FloatArray | None] | None = None

    def at(
        self, trajectory: QueriedTrajectory, stamps_ns: list[int], origin_ns: int
    ) -> tuple[States, FloatArray, FloatArray | None]:
        """Return states at epochs, the covariance of their poses, and its common part; ``origin_ns``: of the trajectory's times."""
        if (max(stamps_ns) - origin_ns) / 1e9 > trajectory.unchanged_until_s:
            return _poses(trajectory, stamps_ns, origin_ns)
        if trajectory is not self._trajectory or any(each not in self._rows for each in stamps_ns):
            following = (each + i * self._period_ns for each in stamps_ns for i in range(1, EPOCHS))
            unchanged_until_ns = origin_ns + 1e9 * trajectory.unchanged_until_s
            cached_ns = sorted({*stamps_ns, *(each for each in following if each <= unchanged_until_ns)})
            self._trajectory, self._found = trajectory, _poses(trajectory, cached_ns, origin_ns)
            self._rows = {each: row for row, each in enumerate(cached_ns)}
        assert self._found is not None  # noqa: S101 (computed above)
        states, covariance, common = self._found
        rows = np.array([self._rows[each] for each in stamps_ns])
        return states.select(rows), covariance[rows], None if common is None else common[rows]


def _poses(
    trajectory: QueriedTrajectory, stamps_ns: list[int], origin_ns: int
) -> tuple[States, FloatArray, FloatArray | None]:
    time_s = (np.array(stamps_ns, dtype=np.int64) - origin_ns) / 1e9
    return (*trajectory.at(time_s, dim=POSE_DIM), trajectory.common_at(time_s, dim=POSE_DIM))


def _times_s(keys: list[tuple[int, int]], origin_ns: int) -> FloatArray:
    return np.array([(epoch_ns - age_ns - origin_ns) / 1e9 for epoch_ns, age_ns in keys])
