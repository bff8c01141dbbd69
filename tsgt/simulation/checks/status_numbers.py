"""Numbers of the status records, recomputed from the stream."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

from tsgt.estimation import usable
from tsgt.model import Status

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tsgt.model import PolarMeasurement
    from tsgt.recording import StationStatus
    from tsgt.simulation.mission import JournalIndex, MasterLog

_TOLERANCE = 1e-6
RATE_WINDOW_NS = 10_000_000_000
MIN_RATE_SPAN_NS = 1_000_000_000
LOCKED = (Status.OK, Status.LOW_ACCURACY, Status.ANGLE_ONLY)
"""Statuses of an instrument that has a target."""


MAX_PERIOD_NS = 1_500_000_000
"""Between two statuses, which come once per second."""

MAX_WRONG_OFFSETS, MIN_OFFSETS = 0.1, 20
"""Share of the clock offsets that may be beyond their bounds: a clock may be stepped between a measurement and the status."""

HEARD_TOLERANCE_S = 0.005
"""Jitter of the stamps of received packets."""

_FOLLOWING = 100_000
"""Numbers by which a station's measurements go on, also after it was restarted; random ones are further away."""

FRESH_S = 1.0
"""Maximum age of a measurement whose stamp tells the clock offset of the status."""


def status_failures(master_log: MasterLog, indices: Mapping[int, JournalIndex]) -> Iterator[str]:
    """Yield the first wrong number of a master's status records, and clock offsets that are often wrong."""
    offsets = list(_offset_errors(master_log, indices))
    wrong = sum(abs(error) > 1 for error in offsets)
    if len(offsets) >= MIN_OFFSETS and wrong > MAX_WRONG_OFFSETS * len(offsets):
        yield f"{wrong} of {len(offsets)} clock offsets of the stations are beyond their bounds"
    stamps_ns = [status.stamp_ns for status in master_log.statuses]
    for stamp_ns, next_ns in pairwise(stamps_ns):
        if not 0 < next_ns - stamp_ns <= MAX_PERIOD_NS:
            at_s = (stamp_ns - master_log.unix_at_zero_ns) / 1e9
            yield f"the status after that of {at_s:.3f} s comes {(next_ns - stamp_ns) / 1e9:.3f} s later"
            break
    for at_s, station, published, problem in _stations(master_log):
        if problem or (problem := _problem(station, published, at_s, master_log.unix_at_zero_ns)):
            yield f"status at {at_s:.3f} s: {problem}"
            return


@dataclass(slots=True)
class _Published:
    """What has been published of a station."""

    measurements: list[PolarMeasurement] = field(default_factory=list)
    usable_count: int = 0
    newest: PolarMeasurement | None = None  # by time; an older one may arrive late
    following: PolarMeasurement | None = None  # by number, of those that follow it

    def add(self, measurement: PolarMeasurement) -> None:
        self.measurements.append(measurement)
        self.usable_count += usable(measurement)
        if self.newest is None or measurement.stamp_ns > self.newest.stamp_ns:
            self.newest = self.following = measurement
        assert self.following is not None  # noqa: S101 (set with the newest)
        if 0 < measurement.sequence - self.following.sequence < _FOLLOWING:
            self.following = measurement


def _stations(master_log: MasterLog) -> Iterator[tuple[float, StationStatus, _Published, str]]:
    """Yield for each status and station its time, what had been published of it, and what is wrong with the poses' counts."""
    by_station: dict[int, _Published] = defaultdict(_Published)
    seen = 0
    for status, (before, latest) in zip(master_log.statuses, master_log.counts_at_status, strict=True):
        problem = ""
        for name in ("poses", "valid_poses"):
            stated, least, most = getattr(status, name), getattr(before, name), getattr(latest, name)
            if not least <= stated <= most:
                problem = f"{stated} {name}, the stream has {least} to {most}"
        for measurement in master_log.measurements[seen : latest.measurements]:
            by_station[measurement.station].add(measurement)
        seen = latest.measurements
        at_s = (status.stamp_ns - master_log.unix_at_zero_ns) / 1e9
        for station in status.stations:
            yield at_s, station, by_station[station.id], problem


def _problem(
    station: StationStatus,
    published: _Published,
    at_s: float,
    unix_at_zero_ns: int,
) -> str:
    """Return what is wrong with the status of a station; empty: nothing."""
    now_ns = round(at_s * 1e9) + unix_at_zero_ns
    expected: list[tuple[str, float | str | None, tuple[float | str | None, ...]]] = [
        ("measurements", station.measurements, (len(published.measurements),)),
        ("usable measurements", station.usable, (published.usable_count,)),
    ]
    if published.newest is not None:
        first, last = published.measurements[0], published.measurements[-1]
        # The newest by time, by arrival, or by number: an older one may arrive late, a station's clock may have been stepped,
        # and the stamp of a distance may precede that of the angles read before it.
        newest = [each for each in (published.newest, last, published.following) if each is not None]
        span_ns = min(RATE_WINDOW_NS, max(now_ns - first.received_ns, MIN_RATE_SPAN_NS))
        count = 0
        for measurement in reversed(published.measurements):
            if measurement.received_ns <= now_ns - RATE_WINDOW_NS:
                break
            count += 1
        expected += [
            ("age", station.age_s, tuple((now_ns - m.stamp_ns) / 1e9 for m in newest)),
            ("rate", station.rate_hz, (count / (span_ns / 1e9),)),
            ("status", station.status, tuple(m.status for m in newest)),
            ("bound of the stamp", station.stamp_bound_ns, tuple(m.stamp_bound_ns for m in newest)),
        ]
        locked = station.status is not None and station.status in LOCKED
        since_s = (now_ns - last.received_ns) / 1e9
        if station.locked != locked:
            return f"station {station.id}: locked {station.locked} with the status {station.status}"
        if (
            station.last_heard_s is None
            or not -_TOLERANCE <= station.last_heard_s <= since_s + HEARD_TOLERANCE_S
        ):
            return f"station {station.id}: last heard {station.last_heard_s} s ago, its last measurement came {since_s:.6f} s ago"
    for what, stated, possible in expected:
        if not any(_equal(stated, each) for each in possible):
            listed = " or ".join(map(str, dict.fromkeys(possible)))
            return f"station {station.id}: {what} {stated}, by the stream {listed}"
    return ""


def _equal(one: float | str | None, other: float | str | None) -> bool:
    if isinstance(one, float) and isinstance(other, int | float):
        return abs(one - other) <= _TOLERANCE
    return one == other


def _offset_errors(master_log: MasterLog, indices: Mapping[int, JournalIndex]) -> Iterator[float]:
    """Yield errors of clock offsets in units of their bounds, where a fresh measurement was stamped with such an offset."""
    for at_s, station, published, _ in _stations(master_log):
        if station.clock_offset_ns is None or station.clock_bound_ns is None or not published.measurements:
            continue
        newest = published.measurements[-1]
        if newest.stamp_bound_ns is None:
            continue  # An error without a time: the stamp is its arrival
        journalled = indices[station.id].find(newest)
        if (
            journalled is not None
            and at_s * 1e9 + master_log.unix_at_zero_ns - newest.stamp_ns < FRESH_S * 1e9
        ):
            true_ns = journalled.stamp_ns - newest.stamp_ns
            yield (station.clock_offset_ns - true_ns) / max(1, station.clock_bound_ns + newest.stamp_bound_ns)
