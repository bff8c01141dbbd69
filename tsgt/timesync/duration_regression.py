"""How much of an exchange's duration delays its response: regression of clock offsets on time and duration.

What an exchange takes longer than the fastest one passes before the instrument takes its time, or after it, or both in a fixed
proportion. Where that holds, each exchange tells how late its response is: without that delay, offsets follow a line, however slow
exchanges become. All times are in ns. A client loads no numpy.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

_WINDOW_NS: Final = 300e9  # crystals change their rate; over a longer window offsets follow no line
_MIN_SAMPLES: Final = 8
_PARAMETERS: Final = 3
_SKEW_WANDER: Final = 1e-6  # within the window

_MIN_SCATTER_NS: Final = 0.3e6  # of times in whole ms
_MAX_SCATTER_NS: Final = 1e6
"""Offsets that scatter by more about the line are not explained by durations."""

_SHARE: Final = 0.5
_SHARE_SIGMA: Final = 0.5
"""Share of a duration that delays the response before it is known, and its sigma."""


class DurationRegression:
    """Fits offset = height + skew * time + share * duration to the exchanges of the last five minutes.

    ``explains``: whether it does. ``skew``: by the last fit. ``scatter``: standard deviation of the offsets about the line.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float, float]] = deque()
        self._mean = (0.0, 0.0, 0.0)
        self._share = self.skew = 0.0
        self._skew_variance = self._share_variance = self._covariance = 0.0
        self.scatter = math.inf

    @property
    def explains(self) -> bool:
        """Whether offsets without delays are known."""
        return self.scatter <= _MAX_SCATTER_NS

    @property
    def span_ns(self) -> float:
        """Duration of the samples."""
        return self._samples[-1][0] - self._samples[0][0] if self._samples else 0.0

    def clear(self) -> None:
        """Forget all samples."""
        self._samples.clear()
        self.scatter = math.inf

    def put(self, x: float, y: float, took: float) -> None:
        """Take the offset and the duration of an exchange at a time."""
        self._samples.append((x, y, took))
        while self._samples[0][0] < x - _WINDOW_NS and len(self._samples) > _MIN_SAMPLES:
            self._samples.popleft()

    def fit(self, known_skew: tuple[float, float]) -> None:
        """Fit the line. ``known_skew``: what is known of the skew otherwise, and its standard deviation."""
        count = len(self._samples)
        if count < _MIN_SAMPLES:
            self.scatter = math.inf
            return
        mean_x, mean_y, mean_took = self._mean = (
            sum([x for x, _, _ in self._samples]) / count,
            sum([y for _, y, _ in self._samples]) / count,
            sum([took for _, _, took in self._samples]) / count,
        )
        centred = [(x - mean_x, y - mean_y, took - mean_took) for x, y, took in self._samples]
        skew, skew_sigma = known_skew
        skew_weight, share_weight = (_MIN_SCATTER_NS / skew_sigma) ** 2, (_MIN_SCATTER_NS / _SHARE_SIGMA) ** 2
        xx = sum([x * x for x, _, _ in centred]) + skew_weight
        tt = sum([took * took for _, _, took in centred]) + share_weight
        xt = sum([x * took for x, _, took in centred])
        xy = sum([x * y for x, y, _ in centred]) + skew_weight * skew
        ty = sum([took * y for _, y, took in centred]) + share_weight * _SHARE
        determinant = xx * tt - xt * xt
        self.skew, self._share = (tt * xy - xt * ty) / determinant, (xx * ty - xt * xy) / determinant
        squares = sum([(y - self.skew * x - self._share * took) ** 2 for x, y, took in centred])
        self.scatter = max(math.sqrt(squares / (count - _PARAMETERS)), _MIN_SCATTER_NS)
        variance = self.scatter**2 / determinant
        self._skew_variance = variance * tt + _SKEW_WANDER**2
        self._share_variance, self._covariance = variance * xx, -variance * xt

    def at(self, x: float, took: float) -> float:
        """Return the offset at a time for an exchange of this duration."""
        mean_x, mean_y, mean_took = self._mean
        return mean_y + self.skew * (x - mean_x) + self._share * (took - mean_took)

    def sigma_at(self, x: float, took: float, took_sigma: float) -> float:
        """Return one sigma of that offset, and of the duration.

        The scatter does not average out: what durations do not explain may delay all responses alike.
        """
        x, took = x - self._mean[0], took - self._mean[2]
        line = (
            x * x * self._skew_variance + took * took * self._share_variance + 2 * x * took * self._covariance
        )
        scatter = self.scatter**2 * (1 + 1 / max(len(self._samples), 1))
        return math.sqrt(line + scatter + (self._share * took_sigma) ** 2)

    def drift(self, x: float) -> float:
        """Return one sigma of the offset by the skew alone."""
        return math.sqrt(self._skew_variance) * abs(x - self._mean[0])
