"""A prism's position between two of its measurements: a straight line in time, unless they are too far apart.

Paper section III-D: linear interpolation of each prism to common epochs, invalid across an outage.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from tsgt.geometry.rigid import FloatArray

NO_GAP_NS = -1
"""``gap_ns`` of an epoch that has no sample before it or none after it."""


@dataclass(frozen=True, slots=True)
class Interpolated:
    """One prism at N epochs, or several.

    Attributes
    ----------
    points
        Positions in m, shape (N, 3); 0 where invalid.
    velocities_mps
        Velocities along the straight lines in m/s, shape (N, 3); 0 where invalid.
    after
        Index of the first sample at or after the epoch, shape (N,); the number of samples where there is none. The
        sample before is the one before it.
    fraction
        Where the epoch lies between the two, 0 exclusive to 1 inclusive, shape (N,); 0 where one of them is missing.
    gap_ns
        Time between the two in ns, shape (N,); :data:`NO_GAP_NS` where one of them is missing.
    valid
        Both samples are there, and not further apart than the outage limit; shape (N,).
    """

    points: FloatArray
    velocities_mps: FloatArray
    after: NDArray[np.int64]
    fraction: FloatArray
    gap_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]


def interpolate(
    times_ns: NDArray[np.int64], points: ArrayLike, epochs_ns: NDArray[np.int64], outage_limit_ns: int
) -> Interpolated:
    """Interpolate a prism's samples linearly to epochs.

    Parameters
    ----------
    times_ns
        Times of the samples in ns, strictly increasing, shape (M,). M may be 0.
    points
        Positions of the samples in m, shape (M, 3).
    epochs_ns
        Times to interpolate to in ns, shape (N,), in any order.
    outage_limit_ns
        Two samples further apart than this leave the time between them invalid; exactly as far is valid.

    Returns
    -------
    Interpolated
        One row per epoch. An epoch on a sample belongs to the interval that ends there, so that it is decided as
        soon as that sample is known.

    Raises
    ------
    GeometryError
        Shapes that do not match, times that do not increase, positions that are not finite.
    """
    times_ns, epochs_ns = np.asarray(times_ns, dtype=np.int64), np.asarray(epochs_ns, dtype=np.int64)
    points = np.asarray(points, dtype=np.float64)
    if points.shape != (len(times_ns), 3):
        raise GeometryError(
            f"{len(times_ns)} sample times need positions of shape ({len(times_ns)}, 3), got {points.shape}"
        )
    if not np.isfinite(points).all():
        raise GeometryError("sample positions are finite numbers, got NaN or infinity")
    if (times_ns[1:] <= times_ns[:-1]).any():
        raise GeometryError("sample times increase strictly: sort the samples and drop repeats first")

    after = np.searchsorted(times_ns, epochs_ns, side="left")
    bracketed = (after > 0) & (after < len(times_ns))
    return _on_lines(times_ns, points, epochs_ns, after, bracketed, outage_limit_ns)


def interpolate_prisms(
    times_ns: NDArray[np.int64],
    points: FloatArray,
    counts: Sequence[int],
    epochs_ns: NDArray[np.int64],
    outage_limit_ns: int,
) -> Interpolated:
    """Do for P prisms at once what :func:`interpolate` does for one, and trust that the samples are in order.

    Parameters
    ----------
    times_ns
        Times of all samples in ns, prism after prism, those of each strictly increasing, shape (M,).
    points
        Positions of the samples in m, shape (M, 3).
    counts
        How many each of the P prisms has.
    epochs_ns
        Times to interpolate to in ns, shape (N,), in any order.
    outage_limit_ns
        As for one.

    Returns
    -------
    Interpolated
        Shapes have a P after the N. ``after`` counts the samples of all prisms, one prism after the other.
    """
    after = np.empty((len(epochs_ns), len(counts)), dtype=np.int64)
    bounds = list(accumulate(counts, initial=0))
    for column, (start, end) in enumerate(pairwise(bounds)):
        after[:, column] = start + times_ns[start:end].searchsorted(epochs_ns)
    bracketed = (after > bounds[:-1]) & (after < bounds[1:])
    return _on_lines(times_ns, points, epochs_ns[:, None], after, bracketed, outage_limit_ns)


def _on_lines(
    times_ns: NDArray[np.int64],
    points: FloatArray,
    epochs_ns: NDArray[np.int64],
    after: NDArray[np.int64],
    bracketed: NDArray[np.bool_],
    outage_limit_ns: int,
) -> Interpolated:
    """Interpolate between each epoch's two samples, where it has them."""
    # Where one is missing, any two stand in: nothing of them is kept.
    if not len(times_ns):
        times_ns, points = np.zeros(1, dtype=np.int64), np.zeros((1, 3))
    start, end = np.where(bracketed, (after - 1, after), 0)
    start_ns = times_ns[start]
    gap_ns = np.where(bracketed, times_ns[end] - start_ns, NO_GAP_NS)
    # Differences of integers first: a Unix time in ns is beyond what a float64 resolves.
    fraction = np.where(bracketed, (epochs_ns - start_ns) / gap_ns, 0.0)
    valid = bracketed & (gap_ns <= outage_limit_ns)

    before = points[start]
    steps = points[end] - before
    at_epochs = np.where(valid[..., None], before + fraction[..., None] * steps, 0.0)
    velocities_mps = np.where(valid[..., None], steps / (gap_ns[..., None] * 1e-9), 0.0)
    return Interpolated(at_epochs, velocities_mps, after, fraction, gap_ns, valid)


def interpolated_covariance(
    cov_before: FloatArray, cov_after: FloatArray, fraction: FloatArray
) -> FloatArray:
    """Propagate the noise of two samples to an epoch on the line between them.

    Parameters
    ----------
    cov_before, cov_after
        Covariances of the two samples in m^2, shape (..., 3, 3).
    fraction
        Where the epoch lies between them, 0 to 1, shape (...).

    Returns
    -------
    FloatArray
        Shape (..., 3, 3), in m^2.
    """
    f = fraction[..., None, None]
    covariance: FloatArray = (1 - f) ** 2 * cov_before + f**2 * cov_after
    return covariance


def interpolation_error_s2(fraction: FloatArray, gap_ns: NDArray[np.int64]) -> FloatArray:
    """By how much the straight line misses the path, per unit of acceleration: t_before t_after / 2.

    Parameters
    ----------
    fraction
        Where the epoch lies between two samples, 0 to 1, of any shape.
    gap_ns
        Time between the two in ns, of the same shape.

    Returns
    -------
    FloatArray
        Of the same shape, in m per m/s^2, for an acceleration that is constant between the samples.
    """
    gap_s = np.asarray(gap_ns) * 1e-9
    missed: FloatArray = (fraction * gap_s) * ((1 - fraction) * gap_s) / 2
    return missed
