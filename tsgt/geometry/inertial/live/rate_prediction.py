"""Linear prediction of the rotation beyond the last sample of the gyro, with coefficients learnt from the samples. Sans-I/O.

A shaken robot turns as a random process with a spectrum, which is not known beforehand: that of its engine, its tracks and the
ground. The angle over the next H samples is predicted by the last p rates, all about the mean of these rates, with the coefficients of
least squares, the same for all axes (J. Makhoul, "Linear prediction: a tutorial review", Proceedings of the IEEE 63(4), 1975, covariance
method). About the mean: a steady turn goes on whatever shook the robot before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.inertial.samples import concatenate_samples

if TYPE_CHECKING:
    from tsgt.geometry.inertial.samples import InertialSamples
    from tsgt.geometry.rigid import FloatArray

ORDER_S, MAX_ORDER = 0.2, 40  # Of rates before the last sample
HORIZON_S, MAX_HORIZON = 0.1, 40  # Beyond it; then the predicted mean rate goes on
MEMORY_S = 60.0  # After which the weight of old samples is 1/e
MIN_LEARNT_S = 10.0
BLOCK_S = 1.0  # Between solutions
SPREAD_S = 0.1
"""Samples whose variance scales that of the prediction: a robot that stops is not shaken any more."""
REGULARISATION = 1e-4  # On the normal matrix, relative to its mean diagonal
_MAX_JITTER = 0.5  # Of the time between samples
_ROUNDING = 1e-14  # Of a mean of rates, relative to them


class PredictedRotation(NamedTuple):
    """Rotation beyond the last sample."""

    rate: FloatArray  # (3,) mean angular rate, rad/s
    sigma_rad: float  # One sigma of each component of the angle


class RotationPredictor:
    """Predicts the rotation beyond the last of the samples that it is given in the order of time."""

    def __init__(self) -> None:
        self._held: InertialSamples | None = None  # Not learnt from yet, and those before them
        self._interval_s = 0.0
        self._order = self._horizon = 0
        self._normal = self._right = self._squares = np.empty(0)
        self._power = self._learnt_s = 0.0
        self._coefficients: FloatArray | None = None  # (H, p) newest rate first

    def learn(self, samples: InertialSamples) -> None:
        """Take samples; those of whole blocks without gaps change the coefficients."""
        held = samples
        if self._held is not None and len(self._held):
            held = concatenate_samples([self._held, samples.select(samples.end_s > self._held.end_s[-1])])
        if not self._order:
            if len(held) < 2:
                self._held = held
                return
            self._begin(float(np.median(np.diff(held.end_s))))
        size = self._order + self._horizon + max(round(BLOCK_S / self._interval_s), 1)
        while len(held) >= size:
            block, held = (
                held.select(slice(size)),
                held.select(slice(size - self._order - self._horizon, None)),
            )
            if self._is_contiguous(block.end_s):
                self._learn(block.angular_rate_radps)
        self._held = held

    def predict(
        self, samples: InertialSamples, bias: FloatArray, duration_s: float
    ) -> PredictedRotation | None:
        """Predict the rotation after the last sample; None: too little learnt, or too few samples in succession.

        ``bias``: of the gyro, (3,).
        """
        if self._coefficients is None or self._learnt_s < MIN_LEARNT_S or len(samples) <= self._order:
            return None
        if not self._power > 0:  # The rates have not changed within any of the SPREAD_S
            return None
        if not self._is_contiguous(samples.end_s[-self._order :]):
            return None
        rates = samples.angular_rate_radps[: -self._order - 1 : -1]
        mean = rates.sum(axis=0) / self._order
        rates = rates - mean
        steps = min(duration_s / self._interval_s, float(self._horizon))
        # Linear between whole numbers of samples, and from none.
        later = max(int(np.ceil(steps)), 1)
        share = steps - (later - 1)
        angle, variance = self._coefficients[later - 1] @ rates, self._squares[later - 1]
        if later > 1:
            angle = share * angle + (1 - share) * (self._coefficients[later - 2] @ rates)
            variance = share * variance + (1 - share) * self._squares[later - 2]
        else:
            angle, variance = share * angle, share**2 * variance
        spread = _spread(rates[: self._spread_rows()])
        # Beyond the horizon the error grows with time.
        growth = max(duration_s / (steps * self._interval_s), 1.0)
        sigma = self._interval_s * np.sqrt(variance / self._power * spread) * growth
        if not np.isfinite(sigma):
            return None
        return PredictedRotation(mean - bias + angle / steps, float(sigma))

    def _begin(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._order = min(max(round(ORDER_S / interval_s), 2), MAX_ORDER)
        self._horizon = min(max(round(HORIZON_S / interval_s), 1), MAX_HORIZON)
        self._normal = np.zeros((self._order, self._order))
        self._right = np.zeros((self._order, self._horizon))
        self._squares = np.zeros(self._horizon)

    def _learn(self, rates: FloatArray) -> None:
        rows = len(rates) - self._order - self._horizon
        # (rows, p, 3) before each instant, newest first, and (rows, H, 3) sums after it.
        windows = np.lib.stride_tricks.sliding_window_view(rates, self._order + self._horizon, axis=0)
        windows = windows[:rows].swapaxes(1, 2)
        before = windows[:, : self._order][:, ::-1]
        mean = before.mean(axis=1, keepdims=True)
        before, after = before - mean, np.cumsum(windows[:, self._order :] - mean, axis=1)
        if np.abs(before).max() <= _ROUNDING * np.abs(rates).max():
            return  # A gyro that has failed, or is too coarse to show that the robot stands: it tells nothing
        spread = _spread(before[:, : self._spread_rows()].swapaxes(0, 1))
        decay = float(np.exp(-rows * self._interval_s / MEMORY_S))
        if self._coefficients is not None:
            # How well the coefficients so far predict what follows.
            error = after - self._coefficients @ before
            self._squares = decay * self._squares + (error**2).sum(axis=(0, 2)) / 3
            self._power = decay * self._power + float(spread.sum())
        x = before.swapaxes(1, 2).reshape(-1, self._order)
        y = after.swapaxes(1, 2).reshape(-1, self._horizon)
        self._normal = decay * self._normal + x.T @ x
        self._right = decay * self._right + x.T @ y
        self._learnt_s += rows * self._interval_s
        load = REGULARISATION * np.trace(self._normal) / self._order
        solved = np.linalg.solve(self._normal + load * np.eye(self._order), self._right)
        self._coefficients = np.ascontiguousarray(solved.T)

    def _spread_rows(self) -> int:
        return min(max(round(SPREAD_S / self._interval_s), 2), self._order)

    def _is_contiguous(self, end_s: FloatArray) -> bool:
        between_s = end_s[1:] - end_s[:-1]
        return bool((np.abs(between_s - self._interval_s) < _MAX_JITTER * self._interval_s).all())


def _spread(rates: FloatArray) -> FloatArray:
    """Variance of rates, (N, ..., 3), about their mean, averaged over the axes."""
    found: FloatArray = rates.var(axis=0).mean(axis=-1)
    return found
