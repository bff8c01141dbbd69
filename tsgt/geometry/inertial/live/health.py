"""Whether the samples of an IMU can be used: checked by themselves, and against the prisms. Sans-I/O."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial.live.saturation import SaturationMonitor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.samples import InertialSamples
    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import ImuParameters

MAX_AGE_S = 0.4
"""Of the newest sample. Lines of ten samples come every 0.05 s at 200 Hz, a busy computer delays them by 0.1 s; after 0.4 s the
poses are no better than without an IMU.
"""

STUCK_S = 0.1
"""Without a change of any of the six values: the noise of 20 samples at 200 Hz changes them, however coarse their steps."""

MAX_RATE_RADPS, MAX_FORCE_MPS2 = 40.0, 350.0
"""Beyond any measuring range (2000 deg/s and 32 g are 35 rad/s and 314 m/s^2): such values are no measurements."""

SHOCK_MPS2 = 50.0
"""Specific force of a shock, on any axis: bumps and slopes give 15 m/s^2, a bracket that is knocked gives hundreds."""

INCONSISTENT_NIS = 25.0
"""NIS (3 degrees of freedom) of a measurement that disagrees with the samples; 1.5 in 100 000 consistent ones exceed it."""
DISAGREEMENT_S = 1.2  # Within which two prisms must disagree: each is measured two or three times in it
SHOCK = "a shock may have displaced it"
DISAGREES_WITH_PRISMS = "it disagrees with the prisms"
"""Reason of a disagreement that innovations show."""
ALONE = 3  # Successive measurements of one prism that disagree, where none other is measured: it cannot be told from the IMU

HOLD_S = 2.0
"""How long the samples must have been consistent again: a few measurements of each prism, which have agreed with them."""


_PART = 100  # Samples at once, which bounds the span in which a limit is looked for


def usable_samples(samples: InertialSamples, imu: ImuParameters) -> InertialSamples:
    """Return those that can be used, judged by themselves."""
    monitor = HealthMonitor(imu)
    parts = [
        monitor.samples(samples.select(slice(first, first + _PART)))
        for first in range(0, len(samples), _PART)
    ]
    return samples.select(np.concatenate(parts)) if parts else samples


def judge_magnitudes(
    angular_rate_radps: FloatArray, specific_force_mps2: FloatArray
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which of N samples, (N, 3) each, are within any measuring range, and which show a shock, beyond it, too."""
    # NaN is below no limit.
    largest_rates, largest_forces = (
        np.maximum.reduce(np.abs(each), axis=1) for each in (angular_rate_radps, specific_force_mps2)
    )
    possible: NDArray[np.bool_] = (largest_rates < MAX_RATE_RADPS) & (largest_forces < MAX_FORCE_MPS2)
    return possible, np.isfinite(largest_forces) & (largest_forces > SHOCK_MPS2)


class HealthMonitor:
    """Judges samples as they arrive, and innovations of the measurements; times on the time scale of the observations.

    Each innovation compares a measured prism with its prediction from the samples since the knots before, so that errors of the
    increments of rotation, velocity and position all enter it, with their covariance and that of the measurement. One
    prism that disagrees is an error of its station. Two that do within :data:`DISAGREEMENT_S` are an error of the IMU: the
    trajectory is as certain of one station as of the others.

    ``saturation``: finds values at the limit of the device, and knows those limits that earlier monitors have met.

    ``setup_doubt``: why the mounting may have changed, a shock or whatever made the samples disagree with the prisms; empty: it has not.
    It stays, whereas ``reason`` passes.
    """

    def __init__(self, imu: ImuParameters, saturation: SaturationMonitor | None = None) -> None:
        self._saturation = saturation or SaturationMonitor(imu)
        self._now_s = -np.inf
        self._newest_s = -np.inf
        self._problem = ""
        self._problem_s = -np.inf
        self.setup_doubt = ""
        self._same_s = 0.0
        self.stuck_from_s = np.inf  # The values have not changed since, for too long
        self._innovations: deque[tuple[float, int, bool]] = deque()

    @property
    def reason(self) -> str | None:
        """Why the samples are rejected now, for people; None: they are used."""
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
        usable, shocks = judge_magnitudes(new.angular_rate_radps, new.specific_force_mps2)
        if not usable.all():
            self._report("values beyond any measuring range", float(new.end_s[~usable][-1]))
        if shocks.any():
            self.setup_doubt = SHOCK
            self._report(SHOCK, float(new.end_s[shocks][-1]))
        unchanged, at_limit = self._saturation.samples(new)
        self._check_stuck(new, unchanged)
        if at_limit.any():
            for sensor, columns in (("angular rate", slice(0, 3)), ("specific force", slice(3, 6))):
                rows = np.flatnonzero(at_limit[:, columns].any(axis=1))
                if len(rows):
                    self._report(f"the {sensor} is at the limit of the device", float(new.end_s[rows[-1]]))
        self._newest_s = max(self._newest_s, float(new.end_s[-1]))
        self._now_s = max(self._now_s, self._newest_s)
        usable &= ~(shocks | at_limit.any(axis=1))
        return usable

    def _check_stuck(self, new: InertialSamples, same: NDArray[np.bool_]) -> None:
        if not same.any() and self._same_s == 0.0:
            return
        for row, is_same in enumerate(same.tolist()):
            self._same_s = self._same_s + float(new.duration_s[row]) if is_same else 0.0
            if not is_same:
                self.stuck_from_s = np.inf
            if self._same_s >= STUCK_S:
                self.stuck_from_s = min(self.stuck_from_s, float(new.end_s[row]) - self._same_s)
                self._report("it repeats the same values", float(new.end_s[row]))

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
        self.setup_doubt = DISAGREES_WITH_PRISMS
        self._report(DISAGREES_WITH_PRISMS, max(self._now_s, float(time_s[-1])))
        self._innovations.clear()
        return True

    def _report(self, problem: str, time_s: float) -> None:
        self._now_s = max(self._now_s, time_s)
        self._problem, self._problem_s = problem, max(self._problem_s, time_s)
