"""Distances between prisms: the rigid robot as its own reference.

Whatever the robot does, the distances between its prisms do not change. How far the measured ones stray from those
of the layout says how well time, frames and interpolation fit together, without any other reference. What the
figures mean is fixed in docs/reference/evaluate.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import interpolate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from tsgt.estimation import Track
    from tsgt.model import Parameters

EPOCH_NS = 50_000_000

# A tracked prism that stands still scatters by a few millimetres; over 0.3 s and more that stays well below this
# speed, and whoever drives slower moves less between two stations' measurements than the noise of one.
MAX_STATIONARY_SPEED_MPS = 0.05
SPEED_BASELINE_NS = 300_000_000
MIN_STATIONARY_NS = 3_000_000_000


@dataclass(frozen=True, slots=True)
class DistanceStatistics:
    """Distances between two prisms in figures, in mm, as ``tsgt evaluate`` reports them; NaN without distances.

    Attributes
    ----------
    reference
        Distance in the prism layout.
    mean, std
        Of the distances.
    mean_abs_error, p95
        Mean and 95th percentile of |distance - reference|.
    valid, invalid
        How many distances there are, and how many epochs had none.
    """

    reference: float
    mean: float
    std: float
    mean_abs_error: float
    p95: float
    valid: int
    invalid: int


@dataclass(frozen=True, slots=True)
class PairDistances:
    """Measured distances between two prisms.

    Attributes
    ----------
    prisms
        Numbers of the two prisms.
    distances_m
        (N,) distances in m.
    reference_m
        Their distance in the prism layout in m.
    invalid
        How many epochs had no valid distance.
    """

    prisms: tuple[int, int]
    distances_m: NDArray[np.float64]
    reference_m: float
    invalid: int

    @property
    def name(self) -> str:
        """The pair as it is called in reports: ``1-2``."""
        return "-".join(map(str, self.prisms))

    def statistics(self) -> DistanceStatistics:
        """Sum the distances up."""
        found = self.distances_m * 1e3
        reference = self.reference_m * 1e3
        error = np.abs(found - reference)
        nothing = len(found) == 0
        return DistanceStatistics(
            reference=reference,
            mean=math.nan if nothing else float(np.mean(found)),
            std=math.nan if nothing else float(np.std(found)),
            mean_abs_error=math.nan if nothing else float(np.mean(error)),
            p95=math.nan if nothing else float(np.percentile(error, 95)),
            valid=len(found),
            invalid=self.invalid,
        )


@dataclass(frozen=True, slots=True)
class InterPrismDistances:
    """Distances between all prisms of a recording.

    Attributes
    ----------
    dynamic
        Per pair, at 20 Hz from interpolated tracks.
    static
        Per pair, from raw measurements while the robot stood still.
    epochs
        How many 20 Hz epochs lie in the span that all tracks cover.
    invalid_epochs
        At how many of them a track's neighbours are further apart than the outage limit.
    still_ns
        Start and end of the intervals in which the robot stood still, in the order of time.
    """

    dynamic: tuple[PairDistances, ...]
    static: tuple[PairDistances, ...]
    epochs: int
    invalid_epochs: int
    stationary_ns: tuple[tuple[int, int], ...]

    @property
    def stationary_s(self) -> float:
        """For how long the robot stood still, in s."""
        return sum(end - start for start, end in self.stationary_ns) / 1e9


@dataclass(frozen=True, slots=True)
class EpochDistances:
    """Distances between all prisms at 20 Hz, from interpolated tracks.

    Attributes
    ----------
    stamp_ns
        (N,) whole multiples of 50 ms in Unix time, in the time that all tracks cover.
    valid
        (N,) no track has a gap there. It takes all of them, so that the pairs are compared over the same stretches.
    distances_m
        By pair of prisms, (N,); NaN where not valid.
    references_m
        By pair of prisms, the distance in the prism layout.
    """

    stamp_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]
    distances_m: dict[tuple[int, int], NDArray[np.float64]]
    references_m: dict[tuple[int, int], float]


def distances_at_epochs(parameters: Parameters, tracks: Mapping[int, Track]) -> EpochDistances:
    """Measure the distances between all prisms at 20 Hz; arguments as for :func:`inter_prism`."""
    layout = {prism.prism: np.array(prism.position_m) for prism in parameters.prisms}
    start, end = _common_span([tracks[prism] for prism in layout])
    epochs = np.arange(-(-start // EPOCH_NS), end // EPOCH_NS + 1, dtype=np.int64) * EPOCH_NS
    limit_ns = parameters.pipeline.outage_limit_ns
    found = {p: interpolate(tracks[p].times_ns, tracks[p].points_m, epochs, limit_ns) for p in layout}
    valid = np.logical_and.reduce([found[prism].valid for prism in layout])
    pairs = list(combinations(layout, 2))
    apart = {(a, b): np.linalg.norm(found[a].points - found[b].points, axis=-1) for a, b in pairs}
    return EpochDistances(
        stamp_ns=epochs,
        valid=valid,
        distances_m={pair: np.where(valid, distances, np.nan) for pair, distances in apart.items()},
        references_m={(a, b): float(np.linalg.norm(layout[a] - layout[b])) for a, b in pairs},
    )


def inter_prism(
    parameters: Parameters,
    tracks: Mapping[int, Track],
    stationary_ns: Sequence[tuple[int, int]] | None = None,
    found: EpochDistances | None = None,
) -> InterPrismDistances:
    """Measure the distances between all prisms, moving and standing.

    Parameters
    ----------
    parameters
        The prism layout (the reference distances) and the outage limit.
    tracks
        One track per prism of the layout, in frame ``station1``, none of them empty.
    still_ns
        When the robot stood still, if something else than the tracks tells it; what of it lies before the first and after
        the last measurement does not count.
    found
        From :func:`distances_at_epochs`, if it is known already.

    Returns
    -------
    InterPrism
        Without epochs where the tracks have no time in common.
    """
    chosen = [tracks[prism.prism] for prism in parameters.prisms]
    found = distances_at_epochs(parameters, tracks) if found is None else found
    if stationary_ns is None:
        still = stationary_intervals(chosen, parameters.pipeline.outage_limit_ns)
    else:
        start, end = min(int(t.times_ns[0]) for t in chosen), max(int(t.times_ns[-1]) for t in chosen)
        still = [(max(a, start), min(b, end)) for a, b in stationary_ns if max(a, start) < min(b, end)]
    invalid = int(np.sum(~found.valid))
    dynamic, static = [], []
    for pair, reference_m in found.references_m.items():
        dynamic.append(PairDistances(pair, found.distances_m[pair][found.valid], reference_m, invalid))
        standing = _raw_distances(tracks[pair[0]], tracks[pair[1]], still)
        static.append(PairDistances(pair, standing, reference_m, 0))
    return InterPrismDistances(
        dynamic=tuple(dynamic),
        static=tuple(static),
        epochs=len(found.stamp_ns),
        invalid_epochs=invalid,
        stationary_ns=tuple(still),
    )


def stationary_intervals(tracks: Sequence[Track], outage_limit_ns: int) -> list[tuple[int, int]]:
    """Find when all prisms stand still.

    A track moves from one position to the first one at least 0.3 s later if that is faster than 0.05 m/s; it is
    unknown, hence not still, across an outage. What no track's motion covers for 3 s or more is still.

    Parameters
    ----------
    tracks
        Tracks that are not empty.
    outage_limit_ns
        Positions further apart than this say nothing about the time between them.

    Returns
    -------
    list of (int, int)
        Start and end of each interval in Unix ns, in the order of time.
    """
    moving: list[tuple[int, int]] = []
    for track in tracks:
        times = track.times_ns
        later = np.searchsorted(times, times + SPEED_BASELINE_NS)
        first = np.flatnonzero(later < len(times))
        second = later[first]
        step_ns = times[second] - times[first]
        step_m = np.linalg.norm(track.points_m[second] - track.points_m[first], axis=-1)
        moves = (step_m > MAX_STATIONARY_SPEED_MPS * step_ns * 1e-9) | (step_ns > outage_limit_ns)
        moving += zip(times[first][moves].tolist(), times[second][moves].tolist(), strict=True)
    start, end = _common_span(tracks)
    still = []
    reached = start
    for leaves, arrives in [*sorted(moving), (end, end)]:
        if min(leaves, end) - reached >= MIN_STATIONARY_NS:
            still.append((reached, min(leaves, end)))
        reached = max(reached, arrives)
    return still


def _common_span(tracks: Sequence[Track]) -> tuple[int, int]:
    return max(int(t.times_ns[0]) for t in tracks), min(int(t.times_ns[-1]) for t in tracks)


def _raw_distances(a: Track, b: Track, intervals: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """Distances from each position of ``a`` to the one of ``b`` nearest in time, within the same interval."""
    distances = [np.empty(0)]
    for start, end in intervals:
        inside_a = (a.times_ns >= start) & (a.times_ns <= end)
        inside_b = (b.times_ns >= start) & (b.times_ns <= end)
        times, partners = a.times_ns[inside_a], b.times_ns[inside_b]
        if len(partners) == 0:
            continue
        nearest = np.searchsorted((partners[1:] + partners[:-1]) // 2, times)
        distances.append(np.linalg.norm(a.points_m[inside_a] - b.points_m[inside_b][nearest], axis=-1))
    return np.concatenate(distances)
