"""Samples of the IMU and of the wheel odometry that a fixed-lag smoother holds: they arrive late, and in any order."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial.preintegration import ContiguousSamples, contiguous
from tsgt.geometry.inertial.samples import InertialSamples, concatenate_samples

if TYPE_CHECKING:
    from tsgt.geometry.inertial.odometry import Odometry, WheelSamples
    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import ImuNoise

MARGIN_S = 0.5  # Before the oldest knot: the sample before a knot tells where the next one begins


class HeldSamples:
    """Samples from a little before the oldest knot on, and from when on they have changed since they were integrated.

    ``odometry`` is None without wheel odometry; ``noise``: of the IMU, as the estimator assumes it.
    """

    def __init__(self, noise: ImuNoise, odometry: Odometry | None) -> None:
        self._noise = noise
        self.odometry = odometry
        self.imu = InertialSamples.none()
        self.stale_from_s = np.inf
        """Samples after this have arrived since the last integration."""

    @property
    def begin_s(self) -> float:
        """Begin of the oldest sample of the IMU; there must be one."""
        return float(self.imu.end_s[0] - self.imu.duration_s[0])

    def add(self, new: InertialSamples, stuck_from_s: float) -> float:
        """Add samples of the IMU and forget those that are stuck; return the time after which the held ones have changed."""
        held = self.imu
        joined = concatenate_samples([each.select(each.end_s <= stuck_from_s) for each in (held, new)])
        changed_s = stuck_from_s
        if len(new):
            if len(held) and new.end_s[0] <= held.end_s[-1]:
                order = np.argsort(joined.end_s, kind="stable")
                # The first of two of the same interval.
                joined = joined.select(order[np.diff(joined.end_s[order], prepend=-np.inf) > 0])
            # The gap before the first of them ends there.
            changed_s = min(changed_s, _end_before(joined.end_s, float(new.end_s[0])))
        self.imu = joined
        self.stale_from_s = min(self.stale_from_s, changed_s)
        return changed_s

    def add_odometry(self, new: WheelSamples) -> float:
        """Add samples of the wheel odometry, at least one; return the time after which the held ones have changed."""
        assert self.odometry is not None  # noqa: S101 (only called with odometry)
        joined = self.odometry.samples.joined(new)
        self.odometry = replace(self.odometry, samples=joined)
        changed_s = _end_before(joined.end_s, float(new.end_s[0]))
        self.stale_from_s = min(self.stale_from_s, changed_s)
        return changed_s

    def clear_imu(self) -> None:
        """Forget the samples of the IMU: they contradict the measurements."""
        self.imu = InertialSamples.none()

    def discard_before(self, time_s: float) -> None:
        """Forget what no knot from a time on needs."""
        if self.odometry is not None:
            driven = self.odometry.samples
            self.odometry = replace(self.odometry, samples=driven.select(driven.end_s > time_s - MARGIN_S))
        if not len(self.imu):
            return
        first = int(self.imu.end_s.searchsorted(time_s - MARGIN_S))
        # The last one, however old: missing ones are filled in from there.
        self.imu = self.imu.select(slice(min(first, len(self.imu) - 1), None))

    def contiguous(self, knots_s: FloatArray) -> ContiguousSamples:
        """Return the samples of the IMU from the first knot to the last; a knot alone needs some too."""
        start_s, end_s = float(knots_s[0]), float(knots_s[-1])
        first, stop = self.imu.end_s.searchsorted((start_s, end_s))
        # One more at each end: where the first one begins, and what comes after the last knot.
        some = self.imu.select(slice(max(int(first) - 1, 0), int(stop) + 1))
        return contiguous(some, self._noise, start_s=start_s, end_s=end_s)


def _end_before(end_s: FloatArray, time_s: float) -> float:
    previous = int(end_s.searchsorted(time_s)) - 1
    return float(end_s[previous]) if previous >= 0 else -np.inf
