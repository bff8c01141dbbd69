"""Errors of the distances between prisms beside how the robot moved at that time. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.inter_prism import EPOCH_NS, PairDistances, still_intervals
from tsgt.geometry import interpolate, rotate, rotation_from_quaternion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.master.pose_batch import PoseBatch
    from tsgt.master.tracks import Track
    from tsgt.model import Parameters

BINS = 8
LEAST_IN_BIN = 20
"""One second of epochs: fewer say nothing about a bin."""


@dataclass(frozen=True, slots=True)
class Motion:
    """How a robot moved at N epochs; NaN where no pose is valid.

    Attributes
    ----------
    speed_mps
        (N,) of the prisms' centroid.
    acceleration_mps2
        (N,) by which that speed grows; negative while the robot slows down.
    turning_radps
        (N,) length of the angular velocity.
    """

    speed_mps: FloatArray
    acceleration_mps2: FloatArray
    turning_radps: FloatArray

    @classmethod
    def unknown(cls, n: int) -> Motion:
        """Make one of which nothing is known."""
        return cls(*(np.full(n, np.nan) for _ in range(3)))


@dataclass(frozen=True, slots=True)
class Ride:
    """Distance errors over time.

    Attributes
    ----------
    stamp_ns
        (N,) 20 Hz epochs in the time that all tracks cover.
    error_m
        By pair's name, (N,) measured distance less that of the layout; NaN where one of the tracks has a gap.
    motion
        How the robot moved then.
    still_ns
        Start and end of the intervals in which it stood still.
    """

    stamp_ns: NDArray[np.int64]
    error_m: dict[str, FloatArray]
    motion: Motion
    still_ns: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Bins:
    """Errors sorted by one quantity into bins of equal width.

    Attributes
    ----------
    edges
        (B + 1,) of the bins.
    counts
        (B,) errors in each.
    median, mean, p95
        (B,) of |error| in m; NaN where there are too few.
    """

    edges: FloatArray
    counts: NDArray[np.int64]
    median: FloatArray
    mean: FloatArray
    p95: FloatArray


@dataclass(frozen=True, slots=True)
class Grid:
    """Mean |error| by two quantities.

    Attributes
    ----------
    x_edges, y_edges
        (X + 1,) and (Y + 1,).
    mean
        (Y, X) in m; NaN where there are too few.
    counts
        (Y, X).
    """

    x_edges: FloatArray
    y_edges: FloatArray
    mean: FloatArray
    counts: NDArray[np.int64]


def ride(
    parameters: Parameters,
    tracks: Mapping[int, Track],
    poses: PoseBatch | None,
    still_ns: Sequence[tuple[int, int]] | None = None,
) -> Ride:
    """Measure the distances over time; as for :func:`tsgt.analysis.inter_prism.inter_prism`.

    Parameters
    ----------
    parameters
        The prism layout and the outage limit.
    tracks
        One per prism of the layout, none of them empty.
    poses
        What tells how the robot moved; None where there are none.
    still_ns
        When it stood still; found from the tracks if this is None.
    """
    layout = {prism.prism: np.array(prism.position_m) for prism in parameters.prisms}
    limit_ns = parameters.pipeline.outage_limit_ns
    chosen = [tracks[prism] for prism in layout]
    start, end = max(int(t.times_ns[0]) for t in chosen), min(int(t.times_ns[-1]) for t in chosen)
    epochs = np.arange(-(-start // EPOCH_NS), end // EPOCH_NS + 1, dtype=np.int64) * EPOCH_NS
    found = {p: interpolate(tracks[p].times_ns, tracks[p].points_m, epochs, limit_ns) for p in layout}
    valid = np.logical_and.reduce([found[p].valid for p in layout])
    error_m = {}
    for a, b in combinations(layout, 2):
        distance = np.linalg.norm(found[a].points - found[b].points, axis=-1)
        error_m[f"{a}-{b}"] = np.where(valid, distance - np.linalg.norm(layout[a] - layout[b]), np.nan)
    centroid_m = np.mean(list(layout.values()), axis=0)
    motion = Motion.unknown(len(epochs)) if poses is None else _motion(poses, centroid_m, epochs)
    if still_ns is None:
        still_ns = still_intervals(chosen, limit_ns)
    return Ride(epochs, error_m, motion, tuple(still_ns))


def standing(
    parameters: Parameters, tracks: Mapping[int, Track], still_ns: Sequence[tuple[int, int]]
) -> tuple[PairDistances, ...]:
    """Measure the distances in given intervals, from raw positions of both prisms that are nearest in time.

    Parameters
    ----------
    parameters, tracks
        As for :func:`ride`.
    still_ns
        Start and end of the intervals.
    """
    layout = {prism.prism: np.array(prism.position_m) for prism in parameters.prisms}
    found = []
    for a, b in combinations(layout, 2):
        distances = [np.empty(0)]
        for start, end in still_ns:
            one, other = (_within(tracks[prism], start, end) for prism in (a, b))
            if len(one) and len(other):
                nearest = np.searchsorted((other.times_ns[1:] + other.times_ns[:-1]) // 2, one.times_ns)
                distances.append(np.linalg.norm(one.points_m - other.points_m[nearest], axis=-1))
        reference_m = float(np.linalg.norm(layout[a] - layout[b]))
        found.append(PairDistances((a, b), np.concatenate(distances), reference_m, 0))
    return tuple(found)


def _within(track: Track, start_ns: int, end_ns: int) -> Track:
    first, last = np.searchsorted(track.times_ns, (start_ns, end_ns + 1))
    return track.select(slice(int(first), int(last)))


def _motion(poses: PoseBatch, centroid_m: FloatArray, epochs: NDArray[np.int64]) -> Motion:
    if len(poses) < 2:
        return Motion.unknown(len(epochs))
    rows = poses.valid
    velocity = np.full((len(poses), 3), np.nan)
    arms = np.cross(poses.angular_velocity_radps[rows], centroid_m)
    turned = rotate(rotation_from_quaternion(poses.orientation_xyzw[rows]), arms)
    velocity[rows] = poses.velocity_mps[rows] + turned
    time_s = (poses.stamp_ns - poses.stamp_ns[0]) / 1e9
    speed = np.linalg.norm(velocity, axis=1)
    turning = np.where(rows, np.linalg.norm(poses.angular_velocity_radps, axis=1), np.nan)
    at_s = (epochs - poses.stamp_ns[0]) / 1e9
    columns = (speed, np.gradient(speed, time_s), turning)
    return Motion(*(np.interp(at_s, time_s, column, left=np.nan, right=np.nan) for column in columns))


def binned(error_m: FloatArray, quantity: FloatArray) -> Bins | None:
    """Sort errors by a quantity; None where there is too little to sort.

    Parameters
    ----------
    error_m
        (P, N) of P pairs at N epochs; NaN where unknown.
    quantity
        (N,); NaN where unknown.
    """
    edges = _edges(quantity)
    if edges is None:
        return None
    place = _places(quantity, edges)
    size = np.abs(error_m)
    found = []
    for i in range(len(edges) - 1):
        some = size[:, place == i]
        some = some[np.isfinite(some)]
        told = len(some) >= LEAST_IN_BIN
        figures = (np.median(some), np.mean(some), np.percentile(some, 95)) if told else (np.nan,) * 3
        found.append((len(some), *map(float, figures)))
    counts, median, mean, p95 = (np.array(column) for column in zip(*found, strict=True))
    return Bins(edges, counts, median, mean, p95)


def gridded(error_m: FloatArray, x: FloatArray, y: FloatArray) -> Grid | None:
    """Sort errors by two quantities; arguments as for :func:`binned`."""
    x_edges, y_edges = _edges(x), _edges(y)
    if x_edges is None or y_edges is None:
        return None
    columns, rows = _places(x, x_edges), _places(y, y_edges)
    shape = (len(y_edges) - 1, len(x_edges) - 1)
    mean, counts = np.full(shape, np.nan), np.zeros(shape, np.int64)
    size = np.abs(error_m)
    for i in range(shape[0]):
        for j in range(shape[1]):
            some = size[:, (rows == i) & (columns == j)]
            some = some[np.isfinite(some)]
            counts[i, j] = len(some)
            if len(some) >= LEAST_IN_BIN:
                mean[i, j] = some.mean()
    return Grid(x_edges, y_edges, mean, counts)


def _edges(quantity: FloatArray) -> FloatArray | None:
    known = quantity[np.isfinite(quantity)]
    if len(known) < LEAST_IN_BIN:
        return None
    # The few largest would leave most bins empty; they are counted in the outermost ones.
    top = float(np.percentile(np.abs(known), 99))
    low = -top if (known < 0.0).any() else 0.0
    return np.linspace(low, top, BINS + 1) if top > 0.0 else None


def _places(quantity: FloatArray, edges: FloatArray) -> NDArray[np.int64]:
    """Bin of each, -1 where it is not known."""
    found = np.clip(np.searchsorted(edges, quantity, side="right") - 1, 0, len(edges) - 2)
    return np.where(np.isfinite(quantity), found, -1)
