"""Statistics of errors in bins of one or two quantities, as the speed of the robot. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

BINS = 8
MIN_BIN_COUNT = 20  # One second of epochs: bins with fewer have no statistics


@dataclass(frozen=True, slots=True)
class Bins:
    """Number, median, mean and 95th percentile of |error| in m, (B,), in B bins of equal width; NaN with too few errors."""

    edges: FloatArray
    counts: NDArray[np.int64]
    median: FloatArray
    mean: FloatArray
    p95: FloatArray


@dataclass(frozen=True, slots=True)
class Grid:
    """Mean |error| in m, (Y, X), and number of errors by two quantities; NaN with too few errors."""

    x_edges: FloatArray
    y_edges: FloatArray
    mean: FloatArray
    counts: NDArray[np.int64]


def binned(error_m: FloatArray, quantity: FloatArray) -> Bins | None:
    """Sort |error|, (P, N) of P pairs, by a quantity, (N,), NaN if unknown; None with too few values."""
    edges = _edges(quantity)
    if edges is None:
        return None
    place = _bin_indices(quantity, edges)
    size = np.abs(error_m)
    found = []
    for i in range(len(edges) - 1):
        some = size[:, place == i]
        some = some[np.isfinite(some)]
        enough = len(some) >= MIN_BIN_COUNT
        figures = (np.median(some), np.mean(some), np.percentile(some, 95)) if enough else (np.nan,) * 3
        found.append((len(some), *map(float, figures)))
    counts, median, mean, p95 = (np.array(column) for column in zip(*found, strict=True))
    return Bins(edges, counts, median, mean, p95)


def gridded(error_m: FloatArray, x: FloatArray, y: FloatArray) -> Grid | None:
    """Sort |error| by two quantities; arguments as for :func:`binned`."""
    x_edges, y_edges = _edges(x), _edges(y)
    if x_edges is None or y_edges is None:
        return None
    columns, rows = _bin_indices(x, x_edges), _bin_indices(y, y_edges)
    shape = (len(y_edges) - 1, len(x_edges) - 1)
    mean, counts = np.full(shape, np.nan), np.zeros(shape, np.int64)
    size = np.abs(error_m)
    for i in range(shape[0]):
        for j in range(shape[1]):
            some = size[:, (rows == i) & (columns == j)]
            some = some[np.isfinite(some)]
            counts[i, j] = len(some)
            if len(some) >= MIN_BIN_COUNT:
                mean[i, j] = some.mean()
    return Grid(x_edges, y_edges, mean, counts)


def _edges(quantity: FloatArray) -> FloatArray | None:
    known = quantity[np.isfinite(quantity)]
    if len(known) < MIN_BIN_COUNT:
        return None
    # Extreme values would leave most bins empty; they count in the outermost bins.
    top = float(np.percentile(np.abs(known), 99))
    low = -top if (known < 0.0).any() else 0.0
    return np.linspace(low, top, BINS + 1) if top > 0.0 else None


def _bin_indices(quantity: FloatArray, edges: FloatArray) -> NDArray[np.int64]:
    """Return the bin of each value, -1 for NaN."""
    found = np.clip(np.searchsorted(edges, quantity, side="right") - 1, 0, len(edges) - 2)
    return np.where(np.isfinite(quantity), found, -1)
