"""Inter-prism distances: the rigid robot as its own reference. Sans-I/O.

The distances between prisms on a rigid robot are constant. Their deviation from those of the layout shows how well time,
frames and interpolation agree, without any other reference. docs/reference/evaluate.md defines the figures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import interpolate
from tsgt.geometry.rest import Series, find_rest_in_series

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from tsgt.estimation import Track
    from tsgt.model import Parameters

EPOCH_NS = 50_000_000

MIN_SIGMA_M = 5e-4  # A recording may state no noise; tests of rest compare with it


@dataclass(frozen=True, slots=True)
class DistanceStatistics:
    """Inter-prism distances in mm, as ``tsgt evaluate`` prints them; NaN without distances.

    ``reference`` is the distance in the layout; ``mean`` and ``std`` are of the distances, ``mean_abs_error`` and ``p95`` mean and
    95th percentile of |distance - reference|; ``valid`` and ``invalid`` count distances, and epochs without one.
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
    """N measured distances between the prisms with these numbers, their distance in the layout, and epochs without a distance."""

    prisms: tuple[int, int]
    distances_m: NDArray[np.float64]
    reference_m: float
    invalid: int

    @property
    def name(self) -> str:
        """Name of the pair in reports: ``1-2``."""
        return "-".join(map(str, self.prisms))

    def statistics(self) -> DistanceStatistics:
        """Summarise the distances."""
        distances = self.distances_m * 1e3
        reference = self.reference_m * 1e3
        if not len(distances):
            return DistanceStatistics(reference, *(math.nan,) * 4, valid=0, invalid=self.invalid)
        error = np.abs(distances - reference)
        return DistanceStatistics(
            reference=reference,
            mean=float(np.mean(distances)),
            std=float(np.std(distances)),
            mean_abs_error=float(np.mean(error)),
            p95=float(np.percentile(error, 95)),
            valid=len(distances),
            invalid=self.invalid,
        )


@dataclass(frozen=True, slots=True)
class InterPrismDistances:
    """Distances between all pairs of prisms of a recording.

    Attributes
    ----------
    dynamic : Per pair, at 20 Hz from interpolated tracks.
    static : Per pair, from raw measurements in stationary intervals.
    epochs : Number of 20 Hz epochs in the span that all tracks cover.
    invalid_epochs : Number of epochs at which the neighbours in a track are further apart than the outage limit.
    stationary_ns : Start and end of the stationary intervals, in the order of time.
    """

    dynamic: tuple[PairDistances, ...]
    static: tuple[PairDistances, ...]
    epochs: int
    invalid_epochs: int
    stationary_ns: tuple[tuple[int, int], ...]

    @property
    def stationary_s(self) -> float:
        """Total duration of the stationary intervals."""
        return sum(end - start for start, end in self.stationary_ns) / 1e9


@dataclass(frozen=True, slots=True)
class EpochDistances:
    """Distances between all prisms at 20 Hz, from interpolated tracks.

    Attributes
    ----------
    stamp_ns : (N,) whole multiples of 50 ms in Unix time, in the span that all tracks cover.
    valid : (N,) no track has a gap. All tracks are required, so that the pairs are compared over the same epochs.
    distances_m : By pair of prisms, (N,); NaN where not valid.
    references_m : By pair of prisms, the distance in the prism layout.
    """

    stamp_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]
    distances_m: dict[tuple[int, int], NDArray[np.float64]]
    references_m: dict[tuple[int, int], float]


def distances_at_epochs(parameters: Parameters, tracks: Mapping[int, Track]) -> EpochDistances:
    """Interpolate all tracks at 20 Hz and measure the distances; arguments as for :func:`inter_prism`."""
    layout = {p.prism: np.array(p.position_m) for p in parameters.prisms if len(tracks[p.prism])}
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
    """Measure the distances between all measured prisms, moving and stationary; no epochs if the tracks do not overlap in time.

    ``tracks``: one per prism of the layout, in frame ``station1``, not all empty. ``stationary_ns``: intervals from another
    source, such as odometry; clipped to the time of the tracks. ``found``: from :func:`distances_at_epochs`, if already
    computed.
    """
    chosen = [tracks[prism.prism] for prism in parameters.prisms if len(tracks[prism.prism])]
    found = distances_at_epochs(parameters, tracks) if found is None else found
    if stationary_ns is None:
        stationary = stationary_intervals(chosen)
    else:
        start, end = min(int(t.times_ns[0]) for t in chosen), max(int(t.times_ns[-1]) for t in chosen)
        stationary = [(max(a, start), min(b, end)) for a, b in stationary_ns if max(a, start) < min(b, end)]
    invalid = int(np.sum(~found.valid))
    dynamic, static = [], []
    for pair, reference_m in found.references_m.items():
        dynamic.append(PairDistances(pair, found.distances_m[pair][found.valid], reference_m, invalid))
        raw_m = _raw_distances(tracks[pair[0]], tracks[pair[1]], stationary)
        static.append(PairDistances(pair, raw_m, reference_m, 0))
    return InterPrismDistances(
        dynamic=tuple(dynamic),
        static=tuple(static),
        epochs=len(found.stamp_ns),
        invalid_epochs=invalid,
        stationary_ns=tuple(stationary),
    )


def stationary_intervals(tracks: Sequence[Track]) -> list[tuple[int, int]]:
    """Return start and end (Unix ns) of the intervals in which no prism moves, in the order of time.

    The tests of rest of the estimator ``continuous``, see docs/explanation/continuous-trajectory.md: prisms that are not
    measured do not matter, as long as another one is. No track may be empty.
    """
    number = 1 + max(int(track.stations.max()) for track in tracks)
    times_ns = np.concatenate([track.times_ns for track in tracks])
    order = np.argsort(times_ns, kind="stable")
    origin_ns = int(times_ns[order[0]])
    variances_m2 = np.concatenate([np.diagonal(track.covariances_m2, axis1=1, axis2=2) for track in tracks])
    sigmas_m = np.maximum(np.sqrt(variances_m2), MIN_SIGMA_M)
    # Another station has other errors of its frame: where it measures the same prism, that does not move.
    numbers = np.concatenate([row * number + track.stations for row, track in enumerate(tracks)])
    series = Series(
        (times_ns[order] - origin_ns) / 1e9,
        np.unique(numbers[order], return_inverse=True)[1].astype(np.intp),
        np.concatenate([track.points_m for track in tracks])[order],
        sigmas_m[order],
        sigmas_m[order],
    )
    return [
        (origin_ns + round(each.start_s * 1e9), origin_ns + round(each.end_s * 1e9))
        for each in find_rest_in_series(series)
    ]


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
