"""Values of an IMU at the limit of an axis, which have less to say than that the motion was beyond. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.samples import InertialSamples
    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import ImuParameters

LIMIT_SPAN_S = 0.5
"""Samples among which values at the limit of an axis are looked for."""
LIMIT_CHANCE = 1e-9
"""Probability that as many values as show a limit are the same by chance: noise changes successive values by some of their steps."""
MIN_CHANCE, STEP_SHARE = 1e-3, 0.5
"""Probability that two values are the same: this share of their step over their noise, at least the first."""
LIMIT_STEPS = 20  # On both sides of a limit, in which less than half as many values must be as at it
MIN_MOTION_STEPS = 40  # Spread of values that change, so that repeated ones are none of a robot at rest
MIN_LIMITS = np.repeat(
    [0.04, 5.0], 3
)  # Of angular rate and specific force, below which a robot at rest repeats values

_MIN_REPEATED = 2  # A value that occurs no more often never shows a limit
_ROUNDING = 1e-9  # Of the product with the gyro matrix, relative
_SIDES = np.array([1.0, -1.0])[:, None, None]  # Upper and lower limit


class SaturationMonitor:
    """Finds values at the limit of an axis, where those repeat exactly that its motion and its noise ought to change.

    Successive ones show a limit, or any of the last half second. From then on a single one is at it, until a value beyond it shows that
    there is no limit any more: an axis that seldom reaches its limit repeats too few values to show it each time anew.
    """

    def __init__(self, imu: ImuParameters) -> None:
        self._to_device = np.linalg.inv(np.array(imu.gyro_matrix))
        self._densities = np.array([imu.noise.gyro_noise_density, imu.noise.accelerometer_noise_density])
        self._recent = np.empty((0, 6))  # Values of the device over the last half second
        self._recent_s = np.empty(0)
        self._recent_at_limit = np.empty((0, 6), np.bool_)
        self._steps = np.full(2, np.inf)  # Smallest change of angular rate and specific force
        self._limits = np.full((2, 6), np.inf)  # Magnitudes of the upper and the lower ones that were found

    def samples(self, new: InertialSamples) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which of N samples, in the order of time, repeat the one before, (N,), and which values are at a limit, (N, 6)."""
        # Of the device itself: the gyro matrix mixes the axes.
        values = np.concatenate([new.angular_rate_radps @ self._to_device.T, new.specific_force_mps2], axis=1)
        before = len(self._recent)
        values = np.concatenate([self._recent, values])
        same = np.zeros(values.shape, np.bool_)
        changes = np.abs(values[1:] - values[:-1])
        # Of a sensor as a whole: the product mixes its axes, of which one may be zero.
        largest = np.maximum.reduce(np.abs(values.reshape(-1, 2, 3)), axis=2)
        largest = np.maximum(largest[1:], largest[:-1])
        same[1:] = (changes.reshape(-1, 2, 3) <= _ROUNDING * largest[:, :, None]).reshape(-1, 6)
        unchanged = np.logical_and.reduce(same[before:], axis=1)
        at_limit = np.concatenate([self._recent_at_limit, self._known(values[before:])])
        at_limit |= self._repeated(values, same, changes, new.duration_s, at_limit)
        self._learn(values, at_limit)
        times_s = np.concatenate([self._recent_s, new.end_s])
        kept = np.flatnonzero((times_s > times_s[-1] - LIMIT_SPAN_S) & np.isfinite(values).all(axis=1))
        self._recent, self._recent_s, self._recent_at_limit = values[kept], times_s[kept], at_limit[kept]
        return unchanged, at_limit[before:]

    def _known(self, values: FloatArray) -> NDArray[np.bool_]:
        """Which values, (N, 6), are at limits from before, after giving up those that one is beyond."""
        if not np.isfinite(self._limits).any():
            return np.zeros(values.shape, np.bool_)
        outwards = _SIDES * values
        beyond = (outwards > self._limits[:, None] * (1.0 + _ROUNDING)).any(axis=1)
        self._limits = np.where(beyond, np.inf, self._limits)
        reached: NDArray[np.bool_] = outwards >= self._limits[:, None] * (1.0 - _ROUNDING)
        known: NDArray[np.bool_] = np.logical_or.reduce(reached & np.isfinite(values), axis=0)
        return known

    def _learn(self, values: FloatArray, at_limit: NDArray[np.bool_]) -> None:
        """Take the limits of values, (M, 6), that are at one."""
        if not at_limit.any():
            return
        reached = np.where(at_limit, _SIDES * values, -np.inf).max(axis=1)
        is_new = (reached > 0.0) & ~(np.abs(reached - self._limits) <= _ROUNDING * reached)
        if is_new.any():
            self._limits = np.where(is_new, reached, self._limits)
            self._steps = np.full(2, np.inf)  # A limit may be between two of them

    def _repeated(
        self,
        values: FloatArray,
        same: NDArray[np.bool_],
        changes: FloatArray,
        duration_s: FloatArray,
        known: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Which values, (M, 6), show a limit by themselves; ``same``: as the one before; ``changes``, (M - 1, 6): from it.

        ``known``, (M, 6): those at a limit that is known.
        """
        changes = np.where(same[1:] | known[1:] | known[:-1], np.inf, changes)
        self._steps = np.fmin(self._steps, changes.reshape(-1, 2, 3).min(axis=(0, 2), initial=np.inf))
        found = np.zeros(values.shape, np.bool_)
        stuck = np.logical_and.reduce(same, axis=1, keepdims=True)
        same &= ~stuck
        most = _most_frequent(values[~stuck[:, 0]])
        if most.max() <= _MIN_REPEATED and not same.any():
            return found
        chance = STEP_SHARE * self._steps * np.sqrt(float(np.median(duration_s))) / self._densities
        log_chance = np.minimum(np.log(np.maximum(chance, MIN_CHANCE)), -1e-9)
        # As often as chance does not repeat a value.
        repeated = np.repeat(np.log(LIMIT_CHANCE) / log_chance, 3)
        rows = np.arange(len(values))[:, None]
        # Of the run of values that are the same.
        begin = np.maximum.accumulate(np.where(same, 0, rows), axis=0)
        long = rows - begin >= repeated
        often = most > np.maximum(repeated, _MIN_REPEATED)
        if not (long.any() or often.any()):
            return found
        steps = np.repeat(self._steps, 3)
        moves = np.ptp(values, axis=0) > MIN_MOTION_STEPS * steps
        # The accelerometer's vertical axis is far from zero at rest.
        others_move = np.ones(6, np.bool_)
        others_move[3:] = moves[[4, 3, 3]] | moves[[5, 5, 4]]
        long &= (np.abs(values) > MIN_LIMITS) & others_move
        for axis in np.flatnonzero(long.any(axis=0)):
            found[:, axis] = np.isin(begin[:, axis], begin[long[:, axis], axis])
        for axis in np.flatnonzero(moves & often):
            changing = values[~stuck[:, 0], axis]
            ordered = np.sort(changing)
            ends = np.flatnonzero(np.diff(ordered, append=np.inf) > _ROUNDING * np.abs(ordered))
            counts = np.diff(ends, prepend=-1)
            run = int(np.argmax(counts))
            value, count = ordered[ends[run]], int(counts[run])
            if abs(value) < MIN_LIMITS[axis]:
                continue
            near = int(np.count_nonzero(np.abs(changing - value) <= LIMIT_STEPS * steps[axis])) - count
            if count > 2 * near:
                found[:, axis] |= np.abs(values[:, axis] - value) <= _ROUNDING * abs(value)
        return found


def _most_frequent(values: FloatArray) -> NDArray[np.intp]:
    """How often the most frequent value of each column of (M, C) occurs, (C,)."""
    ordered = np.sort(values, axis=0)
    differs = ordered[1:] - ordered[:-1] > _ROUNDING * np.abs(ordered[:-1])
    rows = np.arange(1, len(values))[:, None]
    before = np.maximum.accumulate(np.where(differs, rows, 0), axis=0)
    found: NDArray[np.intp] = np.maximum.reduce(rows - before, axis=0, initial=0) + 1
    return found
