"""Regularity of the stations' measurements: rates, gaps, statuses. Sans-I/O."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import usable
from tsgt.model import PolarMeasurement

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.model import Measurement


@dataclass(frozen=True, slots=True)
class StationRecord:
    """N measurements of one station, in the order of time; repeated ones count once.

    Attributes
    ----------
    usable : (N,) whether status and distance allow its use in a pose.
    bound_ns : (N,) of the timestamp error; NaN if unknown.
    delay_s : (N,) from the measurement to its arrival at the master; NaN if unknown.
    statuses : Number of measurements by status.
    distance_m : Minimum and maximum; NaN without distances.
    """

    station: int
    prisms: tuple[int, ...]
    stamp_ns: NDArray[np.int64]
    usable: NDArray[np.bool_]
    bound_ns: FloatArray
    delay_s: FloatArray
    statuses: dict[str, int]
    distance_m: tuple[float, float]


@dataclass(frozen=True, slots=True)
class StationStatistics:
    """Statistics of a station; NaN if unknown.

    Attributes
    ----------
    rate_hz : Usable measurements per second, from the first to the last; NaN with fewer than two.
    longest_gap_s : Longest time without a usable measurement, including start and end of the recording.
    gaps, in_gaps : Number of gaps longer than the outage limit, and their share of the recording.
    delay_median_s, delay_p95_s : From the measurement to its arrival at the master, of those that are neither imported nor merged.
    distance_min_m, distance_max_m : Slope distances.
    """

    measurements: int
    usable: int
    rate_hz: float
    longest_gap_s: float
    gaps: int
    in_gaps: float
    statuses: dict[str, int]
    delay_median_s: float
    delay_p95_s: float
    bound_max_ms: float
    distance_min_m: float
    distance_max_m: float


def station_records(measurements: Sequence[Measurement], stations: Sequence[int]) -> list[StationRecord]:
    """Group measurements by station; the expected ``stations`` come first, with empty records if they have no measurements."""
    by_station: dict[int, dict[int, Measurement]] = {station: {} for station in stations}
    for m in measurements:
        by_station.setdefault(m.station, {}).setdefault(m.stamp_ns, m)
    return [_record(station, [each[t] for t in sorted(each)]) for station, each in by_station.items()]


def _record(station: int, measurements: Sequence[Measurement]) -> StationRecord:
    polar = [m for m in measurements if isinstance(m, PolarMeasurement)]
    distances = [m.slope_distance_m for m in polar if usable(m) and m.slope_distance_m is not None]
    bounds = [getattr(m, "stamp_bound_ns", None) for m in measurements]
    return StationRecord(
        station=station,
        prisms=tuple(sorted({m.prism for m in measurements})),
        stamp_ns=np.array([m.stamp_ns for m in measurements], dtype=np.int64),
        usable=np.array([usable(m) for m in measurements], dtype=np.bool_),
        bound_ns=np.array([np.nan if bound is None else bound for bound in bounds], dtype=np.float64),
        delay_s=_delays_s(measurements),
        statuses=dict(Counter(m.status.value for m in measurements).most_common()),
        distance_m=(min(distances), max(distances)) if distances else (np.nan, np.nan),
    )


def _delays_s(measurements: Sequence[Measurement]) -> FloatArray:
    delay_ns = np.array([m.received_ns - m.stamp_ns for m in measurements], dtype=np.int64)
    # Import and merge have no times of arrival, and set them to those of the measurements.
    return np.where(delay_ns == 0, np.nan, delay_ns / 1e9)


def station_statistics(
    record: StationRecord, *, start_ns: int, end_ns: int, outage_limit_ns: int
) -> StationStatistics:
    """Summarise the measurements of a station over a recording from ``start_ns`` to ``end_ns``."""
    times_ns = record.stamp_ns[record.usable]
    steps_s = np.diff(np.concatenate([[start_ns], times_ns, [end_ns]])) / 1e9
    long = steps_s > outage_limit_ns / 1e9
    span_s = (int(times_ns[-1]) - int(times_ns[0])) / 1e9 if len(times_ns) > 1 else 0.0
    whole_s = (end_ns - start_ns) / 1e9
    delays = record.delay_s[np.isfinite(record.delay_s)]
    known = record.bound_ns[np.isfinite(record.bound_ns)]
    return StationStatistics(
        measurements=len(record.stamp_ns),
        usable=len(times_ns),
        rate_hz=(len(times_ns) - 1) / span_s if span_s > 0 else np.nan,
        longest_gap_s=float(steps_s.max()),
        gaps=int(long.sum()),
        in_gaps=float(steps_s[long].sum() / whole_s) if whole_s > 0 else 0.0,
        statuses=record.statuses,
        delay_median_s=float(np.median(delays)) if len(delays) else np.nan,
        delay_p95_s=float(np.percentile(delays, 95)) if len(delays) else np.nan,
        bound_max_ms=float(known.max()) / 1e6 if len(known) else np.nan,
        distance_min_m=record.distance_m[0],
        distance_max_m=record.distance_m[1],
    )
