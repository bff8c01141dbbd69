"""Inter-prism errors by the motion of the robot. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import centroid_point, poses_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.evaluation import EpochDistances
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray
    from tsgt.model import Parameters

BINS = 8
MIN_BIN_COUNT = 20  # One second of epochs: bins with fewer have no statistics


@dataclass(frozen=True, slots=True)
class RobotMotion:
    """Motion of a robot at N epochs, (N,) each; NaN without a valid pose.

    Speed of the prisms' centroid, its derivative (negative while braking), and norm of the angular velocity.
    """

    speed_mps: FloatArray
    acceleration_mps2: FloatArray
    angular_rate_radps: FloatArray

    @classmethod
    def unknown(cls, n: int) -> RobotMotion:
        """Return N unknown values."""
        return cls(*(np.full(n, np.nan) for _ in range(3)))


@dataclass(frozen=True, slots=True)
class DistanceErrorSeries:
    """Inter-prism errors (measured minus layout, (N,) by pair; NaN in a gap) and motion at 20 Hz where all tracks have data."""

    stamp_ns: NDArray[np.int64]
    error_m: dict[str, FloatArray]
    motion: RobotMotion


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


def distance_error_series(
    parameters: Parameters, found: EpochDistances, poses: PoseBatch | None
) -> DistanceErrorSeries:
    """Relate inter-prism errors to the motion of the robot, which follows from ``poses`` (None: unknown)."""
    error_m = {f"{a}-{b}": m - found.references_m[a, b] for (a, b), m in found.distances_m.items()}
    unknown = RobotMotion.unknown(len(found.stamp_ns))
    if poses is None:
        return DistanceErrorSeries(found.stamp_ns, error_m, unknown)
    motion = _motion(poses_at(poses, centroid_point(parameters)), found.stamp_ns)
    return DistanceErrorSeries(found.stamp_ns, error_m, motion)


def _motion(poses: PoseBatch, epochs: NDArray[np.int64]) -> RobotMotion:
    if len(poses) < 2:
        return RobotMotion.unknown(len(epochs))
    rows = poses.valid
    time_s = (poses.stamp_ns - poses.stamp_ns[0]) / 1e9
    speed = np.where(rows, np.linalg.norm(poses.velocity_mps, axis=1), np.nan)
    angular_rate = np.where(rows, np.linalg.norm(poses.angular_velocity_radps, axis=1), np.nan)
    at_s = (epochs - poses.stamp_ns[0]) / 1e9
    columns = (speed, np.gradient(speed, time_s), angular_rate)
    return RobotMotion(*(np.interp(at_s, time_s, column, left=np.nan, right=np.nan) for column in columns))


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
