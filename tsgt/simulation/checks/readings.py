"""Journalled distances beside those that the instrument reported."""

from __future__ import annotations

from statistics import median
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.model import PolarMeasurement
    from tsgt.simulation.instrument import ReportedDistance
    from tsgt.simulation.mission import JournalIndex

# GeoCOM sends ten decimals or more.
_LINE_ROUNDING = 1e-9


def readings_by_start(
    index: JournalIndex,
) -> Iterator[list[tuple[PolarMeasurement, ReportedDistance | None]]]:
    """Yield for each start of the client the distances in its journal, each with what the instrument reported; None: nothing like it."""
    by_time_ms: dict[int, list[ReportedDistance]] = {}
    for each in index.station_log.reported_distances:
        by_time_ms.setdefault(each.instrument_ms, []).append(each)
    for measurements in index.journalled_by_start:
        found = []
        for journalled in measurements:
            if journalled.slope_distance_m is None or journalled.instrument_time_ns is None:
                continue
            candidates = by_time_ms.get(journalled.instrument_time_ns // 1_000_000, [])
            found.append(
                (journalled, next((each for each in candidates if _matches(each, journalled)), None))
            )
        yield found


def median_stamp_error_s(index: JournalIndex, from_s: float, to_s: float) -> float:
    """Return the median error of the stamps of distances that were measured in a time; 0 without any."""
    errors_ns = [
        stamp_ns - truth.true_ns
        for readings in readings_by_start(index)
        for journalled, truth in readings
        if truth is not None and from_s <= truth.true_ns / 1e9 <= to_s
        if (stamp_ns := index.true_ns(journalled)) is not None
    ]
    return median(errors_ns) / 1e9 if errors_ns else 0.0


def _matches(reported: ReportedDistance, journalled: PolarMeasurement) -> bool:
    pairs = (
        (reported.horizontal_angle_rad, journalled.horizontal_angle_rad),
        (reported.zenith_angle_rad, journalled.zenith_angle_rad),
        (reported.distance_m, journalled.slope_distance_m),
    )
    return all(value is not None and abs(given - value) < _LINE_ROUNDING for given, value in pairs)
