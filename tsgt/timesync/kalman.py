"""What is known of one clock against another at an instant, carried through time and corrected by comparisons.

Two numbers are followed: the offset, in us, and the rate, in ppm, which is us of offset per s. The rate is a random
walk: the longer ago a comparison, the less it says. This is the Kalman filter for that, written out for two numbers,
and since the walk looks the same in both directions of time, it can be run backwards as well. :func:`merged` makes one
estimate of what came before and what came after an instant (the two-filter smoother: Fraser and Potter 1969).
"""

from __future__ import annotations

from typing import NamedTuple


class Estimate(NamedTuple):
    """Offset and rate at one instant, with their covariance.

    Attributes
    ----------
    offset_us, rate_ppm
        Most likely values.
    offset_variance, covariance, rate_variance
        In us^2, us ppm and ppm^2.
    """

    offset_us: float
    rate_ppm: float
    offset_variance: float
    covariance: float
    rate_variance: float


def carried(estimate: Estimate, by_s: float, walked_ppm2: float) -> Estimate:
    """Return what an estimate says of another instant.

    Parameters
    ----------
    estimate
        At one instant.
    by_s
        How much later the other is; negative: earlier.
    walked_ppm2
        Variance of what the rate may have changed by in between.
    """
    offset_us, rate_ppm, offset_variance, covariance, rate_variance = estimate
    return Estimate(
        offset_us + by_s * rate_ppm,
        rate_ppm,
        offset_variance + by_s * (2 * covariance + by_s * (rate_variance + walked_ppm2 / 3)),
        covariance + by_s * (rate_variance + walked_ppm2 / 2),
        rate_variance + walked_ppm2,
    )


def corrected(estimate: Estimate, offset_us: float, variance: float) -> Estimate:
    """Return the estimate after a comparison of the clocks.

    Parameters
    ----------
    estimate
        At the instant of the comparison.
    offset_us, variance
        What it showed, and its variance in us^2.
    """
    expected_us, rate_ppm, offset_variance, covariance, rate_variance = estimate
    missed_us, total = offset_us - expected_us, offset_variance + variance
    of_offset, of_rate = offset_variance / total, covariance / total
    return Estimate(
        expected_us + of_offset * missed_us,
        rate_ppm + of_rate * missed_us,
        of_offset * variance,
        of_rate * variance,
        rate_variance - of_rate * covariance,
    )


def merged(one: Estimate, other: Estimate) -> Estimate:
    """Return what two independent estimates of the same instant say together."""
    missed_us, missed_ppm = other.offset_us - one.offset_us, other.rate_ppm - one.rate_ppm
    p, q, r = one.offset_variance, one.covariance, one.rate_variance
    a, b, c = p + other.offset_variance, q + other.covariance, r + other.rate_variance
    determinant = a * c - b * b
    # The gain is P (P + P')^-1, with P the covariance of the first and P' of the other.
    g00, g01 = (p * c - q * b) / determinant, (q * a - p * b) / determinant
    g10, g11 = (q * c - r * b) / determinant, (r * a - q * b) / determinant
    return Estimate(
        one.offset_us + g00 * missed_us + g01 * missed_ppm,
        one.rate_ppm + g10 * missed_us + g11 * missed_ppm,
        p - g00 * p - g01 * q,
        q - g00 * q - g01 * r,
        r - g10 * q - g11 * r,
    )
