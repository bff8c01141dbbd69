"""The model that the clock estimators share: a straight line of clock offset over time, with its covariance.

The offset is ``offset + skew * dt``; the skew is a random walk, so an estimate loses weight with age. Kalman filter:
Bar-Shalom, Li, Kirubarajan 2001, section 6.2, continuous white noise acceleration. It also runs backwards; forward and
backward estimates are fused (two-filter smoother: Fraser and Potter 1969). Units: us and ppm, or ns and ns/s.
"""

from __future__ import annotations

from typing import NamedTuple


class ClockLine(NamedTuple):
    """Offset and skew at one instant, with their covariance."""

    offset: float
    skew: float
    offset_variance: float
    covariance: float
    skew_variance: float

    def offset_at(self, dt_s: float) -> float:
        """Return the offset ``dt_s`` later; negative: earlier."""
        return self.offset + dt_s * self.skew

    def variance_at(self, dt_s: float, skew_walk: float = 0.0) -> float:
        """Return the variance of :meth:`offset_at`; ``skew_walk`` is the variance of the skew's change meanwhile."""
        return self.offset_variance + dt_s * (
            2 * self.covariance + dt_s * (self.skew_variance + skew_walk / 3)
        )

    def propagate(self, dt_s: float, skew_walk: float) -> ClockLine:
        """Predict the line ``dt_s`` later (negative: earlier); ``skew_walk`` as for :meth:`variance_at`."""
        return ClockLine(
            self.offset_at(dt_s),
            self.skew,
            self.variance_at(dt_s, skew_walk),
            self.covariance + dt_s * (self.skew_variance + skew_walk / 2),
            self.skew_variance + skew_walk,
        )

    def update(self, offset: float, variance: float) -> ClockLine:
        """Correct the line by an offset measured at its instant, with the given variance."""
        predicted, skew, offset_variance, covariance, skew_variance = self
        innovation, total = offset - predicted, offset_variance + variance
        offset_gain, skew_gain = offset_variance / total, covariance / total
        return ClockLine(
            predicted + offset_gain * innovation,
            skew + skew_gain * innovation,
            offset_gain * variance,
            skew_gain * variance,
            skew_variance - skew_gain * covariance,
        )

    def fuse(self, other: ClockLine) -> ClockLine:
        """Combine two independent estimates of the same instant, with the gain ``P (P + P')^-1``."""
        offset_difference, skew_difference = other.offset - self.offset, other.skew - self.skew
        p, q, r = self.offset_variance, self.covariance, self.skew_variance
        a, b, c = p + other.offset_variance, q + other.covariance, r + other.skew_variance
        determinant = a * c - b * b
        g00, g01 = (p * c - q * b) / determinant, (q * a - p * b) / determinant
        g10, g11 = (q * c - r * b) / determinant, (r * a - q * b) / determinant
        return ClockLine(
            self.offset + g00 * offset_difference + g01 * skew_difference,
            self.skew + g10 * offset_difference + g11 * skew_difference,
            p - g00 * p - g01 * q,
            q - g00 * q - g01 * r,
            r - g10 * q - g11 * r,
        )


def pooled_variance(
    sum_of_squares: float, freedom: float, *, prior_sigma: float, prior_weight: float
) -> float:
    """Estimate a variance from residuals and a prior that counts as ``prior_weight`` more of them.

    The mean of the scaled inverse chi-square posterior, but for the usual -2 (Gelman et al., *Bayesian Data Analysis*,
    section 2.6).
    """
    return (prior_weight * prior_sigma**2 + sum_of_squares) / (prior_weight + freedom)
