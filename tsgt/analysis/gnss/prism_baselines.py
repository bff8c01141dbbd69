"""Distances between prisms over time, for comparison with those between GNSS receivers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import distances_at_epochs
from tsgt.analysis.gnss.baselines import DistanceSeries
from tsgt.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.estimation import Track
    from tsgt.model import Parameters


def prism_distances(
    parameters: Parameters, tracks: Mapping[int, Track], path: Path
) -> tuple[DistanceSeries, ...]:
    """Measure the distances between all prisms over time, as ``tsgt evaluate`` does: at 20 Hz, all pairs or none.

    Parameters
    ----------
    parameters : The prism layout (the reference distances) and the outage limit.
    tracks : One track per prism of the layout, in frame ``station1``.

    Raises
    ------
    RecordingError : A prism was not measured, or the layout has only one prism.
    """
    missing = [prism.prism for prism in parameters.prisms if not len(tracks[prism.prism])]
    if missing or len(parameters.prisms) < 2:
        reason = f"prism {missing[0]} was not measured" if missing else "it has one prism only"
        raise RecordingError(f"no distances between prisms: {reason}", path=path)
    found = distances_at_epochs(parameters, tracks)
    return tuple(
        DistanceSeries(
            name=f"{a}-{b}",
            times_ns=found.stamp_ns[found.valid],
            distances_m=distances_m[found.valid],
            reference_m=found.references_m[a, b],
            quality=None,
            invalid_ns=found.stamp_ns[~found.valid],
        )
        for (a, b), distances_m in found.distances_m.items()
    )


def common_interval(
    gnss: Sequence[DistanceSeries], prisms: Sequence[DistanceSeries], path: Path
) -> tuple[tuple[DistanceSeries, ...], tuple[DistanceSeries, ...]]:
    """Cut distances between receivers and between prisms to the time interval that both cover.

    Raises
    ------
    RecordingError : They do not overlap in time.
    """
    gnss_span, prism_span = time_span(gnss), time_span(prisms)
    if gnss_span is None or prism_span is None:
        which = "receivers" if gnss_span is None else "prisms"
        raise RecordingError(f"nothing to compare: there are no distances between {which}", path=path)
    start_ns, end_ns = max(gnss_span[0], prism_span[0]), min(gnss_span[1], prism_span[1])
    if start_ns > end_ns:
        late = prism_span[0] > gnss_span[1]
        raise RecordingError(
            f"its distances {'begin' if late else 'end'} {(start_ns - end_ns) / 1e9:.1f} s "
            f"{'after the end' if late else 'before the start'} of the receivers'; was the master's clock right?",
            path=path,
        )
    both = tuple(tuple(pair.between(start_ns, end_ns) for pair in pairs) for pairs in (gnss, prisms))
    if None in map(time_span, both):
        raise RecordingError(
            "while its prisms were measured the receivers had no common positions", path=path
        )
    return both[0], both[1]


def time_span(pairs: Sequence[DistanceSeries]) -> tuple[int, int] | None:
    """Return the first and the last time of any distance; None without one."""
    times = np.concatenate([np.empty(0, np.int64), *(pair.times_ns for pair in pairs)])
    return (int(times.min()), int(times.max())) if len(times) else None
