"""Linear interpolation of a prism's track to common epochs, invalid across an outage (paper section III-D)."""

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

NO_GAP_NS = -1  # ``gap_ns`` of an epoch without a sample before or after it


@dataclass(frozen=True, slots=True)
class Interpolated:
    """One prism at N epochs, or several."""

    points: FloatArray  # (N, 3) positions in m; 0 where invalid
    velocities_mps: FloatArray  # (N, 3) slopes of the interpolation; 0 where invalid
    # (N,) index of the first sample at or after the epoch; the number of samples where there is none. The other
    # sample of the interval is the one before it.
    after: NDArray[np.int64]
    # (N,) position of the epoch in the interval, 0 exclusive to 1 inclusive; 0 where a sample is missing
    fraction: FloatArray
    gap_ns: NDArray[np.int64]  # (N,) length of the interval; :data:`NO_GAP_NS` where a sample is missing
    valid: NDArray[np.bool_]  # (N,) both samples exist, not further apart than the outage limit


def interpolate(
    times_ns: NDArray[np.int64], points: ArrayLike, epochs_ns: NDArray[np.int64], outage_limit_ns: int
) -> Interpolated:
    """Interpolate a prism's samples linearly to epochs.

    Raises GeometryError: shapes that do not match, times that do not increase, positions that are not finite.

    Parameters
    ----------
    times_ns : (M,) sample times, strictly increasing; M may be 0.
    points : (M, 3) sample positions in m.
    epochs_ns : (N,) in any order.
    outage_limit_ns : Longest valid interval between two samples, inclusive.

    Returns one row per epoch. An epoch on a sample belongs to the interval that ends there, so that it is decided as soon
    as that sample is known.
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
    """Interpolate the samples of P prisms as :func:`interpolate` does for one, without its checks.

    ``times_ns``, (M,), and ``points``, (M, 3) in m, are prism after prism, strictly increasing within each; ``counts``
    are the samples of each prism. The result has shapes (N, P, ...); its ``after`` indexes the samples of all prisms.
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
    # Where a sample is missing, any index will do: the result is masked.
    if not len(times_ns):
        times_ns, points = np.zeros(1, dtype=np.int64), np.zeros((1, 3))
    start, end = np.where(bracketed, (after - 1, after), 0)
    start_ns = times_ns[start]
    gap_ns = np.where(bracketed, times_ns[end] - start_ns, NO_GAP_NS)
    # Integer differences first: float64 does not resolve a Unix time in ns.
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
    """Propagate the noise of two samples, (..., 3, 3) in m^2, to an epoch at a fraction, (...), of their interval."""
    f = fraction[..., None, None]
    covariance: FloatArray = (1 - f) ** 2 * cov_before + f**2 * cov_after
    return covariance


def interpolation_error_s2(fraction: FloatArray, gap_ns: NDArray[np.int64]) -> FloatArray:
    """Error of linear interpolation per unit of constant acceleration, in m per m/s^2: t_before t_after / 2.

    ``fraction``: position of the epoch in the interval, 0 to 1; ``gap_ns``: the interval's length; of the same shape.
    """
    gap_s = np.asarray(gap_ns) * 1e-9
    error_s2: FloatArray = (fraction * gap_s) * ((1 - fraction) * gap_s) / 2
    return error_s2
