"""Whether the samples of an IMU can be believed: by themselves, and against the prisms. Sans-I/O."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.samples import InertialSamples
    from tsgt.geometry.rigid import FloatArray

MAX_AGE_S = 0.4
"""Of the newest sample. Lines of ten samples come every 0.05 s at 200 Hz, a busy computer delays them by 0.1 s; after 0.4 s the
poses are no better than without an IMU.
"""

STUCK_S = 0.1
"""Without a change of any of the six values: the noise of 20 samples at 200 Hz changes them, however coarse their steps."""

MAX_RATE_RADPS, MAX_FORCE_MPS2 = 40.0, 350.0
"""Beyond any measuring range (2000 deg/s and 32 g are 35 rad/s and 314 m/s^2): such values are no measurements."""

SATURATED_SAMPLES, SATURATED_RATE_RADPS, SATURATED_FORCE_MPS2 = 4, 1.5, 19.0
SATURATED_RATE_CHANGE = 2e-3
"""An axis is at its limit if so many successive values, above these magnitudes, are the same: forces exactly, angular rates to
this share, for the gyro matrix adds a little of the other axes. A robot that turns or is hit so fast never does it so evenly.
"""

INCONSISTENT_NIS = 25.0
"""NIS (3 degrees of freedom) of a measurement that disagrees with the samples; 1.5 in 100 000 consistent ones exceed it."""
DISAGREEMENT_S = 1.2  # Within which two prisms must disagree: each is measured two or three times in it
ALONE = 3  # Successive measurements of one prism that disagree, where none other is measured: it cannot be told from the IMU

HOLD_S = 2.0
"""For which the samples must have been sound again: a few measurements of each prism, which have agreed with them."""


class HealthMonitor:
    """Judges samples as they arrive, and innovations of the measurements; times on the time scale of the observations.

    Each innovation compares a measured prism with its prediction from the samples since the knots before, so that errors of the
    increments of rotation, velocity and position all enter it, with their covariance and that of the measurement. One
    prism that disagrees is an error of its station. Two that do within :data:`DISAGREEMENT_S` are an error of the IMU: the
    trajectory is as certain of one station as of the others.
    """

    def __init__(self) -> None:
        self._now_s = -np.inf
        self._newest_s = -np.inf
        self._problem = ""
        self._problem_s = -np.inf
        self._last: FloatArray | None = None  # (6,) values of the newest sample
        self._same_s = 0.0
        self.stuck_from_s = np.inf  # The values have not changed since, for too long
        self._level_count = np.zeros(6, np.int64)  # Successive samples with the same value of each axis
        self._innovations: deque[tuple[float, int, bool]] = deque()

    @property
    def reason(self) -> str | None:
        """Why the samples are not to be believed now, for people; None: they are."""
        if self._now_s - self._problem_s < HOLD_S:
            return self._problem
        age_s = self._now_s - self._newest_s
        if not age_s > MAX_AGE_S:
            return None
        return f"no samples for {age_s:.1f} s" if np.isfinite(age_s) else "no samples"

    def advance(self, now_s: float) -> None:
        """Take the present time, when a prediction is asked for."""
        self._now_s = max(self._now_s, now_s)

    def samples(self, new: InertialSamples) -> NDArray[np.bool_]:
        """Judge samples in the order of time; return which, (N,), can be used but for those after :attr:`stuck_from_s`."""
        values = np.concatenate([new.angular_rate_radps, new.specific_force_mps2], axis=1)
        sound: NDArray[np.bool_] = np.isfinite(values).all(axis=1)
        sound &= np.abs(values[:, :3]).max(axis=1) < MAX_RATE_RADPS
        sound &= np.abs(values[:, 3:]).max(axis=1) < MAX_FORCE_MPS2
        if not sound.all():
            self._report("values beyond any measuring range", float(new.end_s[~sound][-1]))
        limits = np.repeat([SATURATED_RATE_RADPS, SATURATED_FORCE_MPS2], 3)
        tolerance = np.repeat([SATURATED_RATE_CHANGE, 0.0], 3)
        previous = np.concatenate([values[:1] if self._last is None else self._last[None], values[:-1]])
        level = (np.abs(values - previous) <= tolerance * np.abs(values)) & (np.abs(values) > limits)
        same = (values == previous).all(axis=1)
        if self._last is None:
            level[0], same[0] = False, False
        for row in np.flatnonzero(same | level.any(axis=1) | (self._same_s > 0) | self._level_count.any()):
            self._same_s = self._same_s + float(new.duration_s[row]) if same[row] else 0.0
            if not same[row]:
                self.stuck_from_s = np.inf
            self._level_count = np.where(level[row], self._level_count + 1, 0)
            if self._same_s >= STUCK_S:
                self.stuck_from_s = min(self.stuck_from_s, float(new.end_s[row]) - self._same_s)
                self._report("it repeats the same values", float(new.end_s[row]))
            elif (self._level_count >= SATURATED_SAMPLES - 1).any():
                sound[row] = False
                sensor = (
                    "angular rate"
                    if (self._level_count[:3] >= SATURATED_SAMPLES - 1).any()
                    else "specific force"
                )
                self._report(f"the {sensor} is at the limit of the device", float(new.end_s[row]))
        self._last = values[-1]
        self._newest_s = max(self._newest_s, float(new.end_s[-1]))
        self._now_s = max(self._now_s, self._newest_s)
        return sound

    def innovations(self, time_s: FloatArray, prism: NDArray[np.intp], nis: FloatArray) -> bool:
        """Judge the normalised innovations squared of new measurements; return whether the samples disagree with them."""
        for each in zip(time_s.tolist(), prism.tolist(), (nis > INCONSISTENT_NIS).tolist(), strict=True):
            self._innovations.append(each)
        while self._innovations and self._innovations[0][0] < time_s[-1] - DISAGREEMENT_S:
            self._innovations.popleft()
        inconsistent = {prism for _, prism, is_inconsistent in self._innovations if is_inconsistent}
        measured = {prism for _, prism, _ in self._innovations}
        newest = [is_inconsistent for *_, is_inconsistent in self._innovations][-ALONE:]
        alone = len(measured) == 1 and len(newest) == ALONE and all(newest)
        if len(inconsistent) < 2 and not alone:
            return False
        self._report("it disagrees with the prisms", max(self._now_s, float(time_s[-1])))
        self._innovations.clear()
        return True

    def _report(self, problem: str, time_s: float) -> None:
        self._now_s = max(self._now_s, time_s)
        self._problem, self._problem_s = problem, max(self._problem_s, time_s)
