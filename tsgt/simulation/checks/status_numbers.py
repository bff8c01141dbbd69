"""Numbers of the status records, recomputed from the stream."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

from tsgt.estimation import usable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.model import PolarMeasurement
    from tsgt.recording import StationStatus
    from tsgt.simulation.mission import MasterLog

_AGE_TOLERANCE_S = 1e-6
RATE_WINDOW_NS = 10_000_000_000
MIN_RATE_SPAN_NS = 1_000_000_000
_RATE_TOLERANCE_HZ = 1e-6


def status_failures(master_log: MasterLog) -> Iterator[str]:
    """Yield the first wrong number of a master's status records."""
    by_station: dict[int, list[PolarMeasurement]] = defaultdict(list)
    usable_counts: dict[int, int] = defaultdict(int)
    seen = 0
    for status, (before, latest) in zip(master_log.statuses, master_log.counts_at_status, strict=True):
        where = f"status at {(status.stamp_ns - master_log.unix_at_zero_ns) / 1e9:.3f} s"
        for name in ("poses", "valid_poses"):
            stated, least, most = getattr(status, name), getattr(before, name), getattr(latest, name)
            if not least <= stated <= most:
                yield f"{where}: {stated} {name}, the stream has {least} to {most}"
                return
        for measurement in master_log.measurements[seen : latest.measurements]:
            by_station[measurement.station].append(measurement)
            usable_counts[measurement.station] += usable(measurement)
        seen = latest.measurements
        for station in status.stations:
            published = by_station[station.id]
            for what, stated, expected, tolerance in _expected(
                station, published, usable_counts[station.id], status.stamp_ns
            ):
                if stated is None or all(abs(stated - each) > tolerance for each in expected):
                    listed = " or ".join(f"{each:.9g}" for each in expected)
                    yield f"{where}: station {station.id}: {what} {stated}, by the stream {listed}"
                    return


def _expected(
    station: StationStatus, published: list[PolarMeasurement], usable_count: int, now_ns: int
) -> Iterator[tuple[str, float | None, tuple[float, ...], float]]:
    """Yield name, stated value, possible values and tolerance of what the measurements of a station tell."""
    yield "measurements", station.measurements, (len(published),), 0.0
    yield "usable measurements", station.usable, (usable_count,), 0.0
    if not published:
        return
    # The newest by time, or by arrival: an older one may arrive late, and a station's clock may have been stepped.
    newest = (max(m.stamp_ns for m in published), published[-1].stamp_ns)
    yield "age", station.age_s, tuple((now_ns - stamp_ns) / 1e9 for stamp_ns in newest), _AGE_TOLERANCE_S
    span_ns = min(RATE_WINDOW_NS, max(now_ns - published[0].received_ns, MIN_RATE_SPAN_NS))
    count = 0
    for measurement in reversed(published):
        if measurement.received_ns <= now_ns - RATE_WINDOW_NS:
            break
        count += 1
    yield "rate", station.rate_hz, (count / (span_ns / 1e9),), _RATE_TOLERANCE_HZ
