"""Events of the stations against measurements and status: of an instrument's status and battery, and of lost stations."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from tsgt.model import Status

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.recording import StatusRecord
    from tsgt.simulation.mission import MasterLog

LOST_S = 20.0
"""A station that has not been heard for longer must have been reported as lost: that takes 5 s, while it is polled or has slots."""

CLASSIC_LOST_S = 80.0
"""The same over ``classic``, which polls nobody while it synchronises three stations, for up to a minute."""

HEARD_S = 0.5
"""A station that was heard less than this ago must have been reported as recovered."""


LOW_BATTERY_PERCENT, CHARGED_BATTERY_PERCENT = 20, 30
"""Below the first a battery is low, from the second on it no longer is."""


NO_DISTANCE_NS = 2_000_000_000
"""Angles without a distance are an event if they last this long."""

MAX_SEQUENCE_STEP = 100_000
"""Numbers of measurements that continue others; a run that could not write its journal has numbers of its own."""


def event_failures(master_log: MasterLog, *, superframe: bool) -> Iterator[str]:
    """Yield the stations of which events are missing, or were not called for."""
    events = Counter((event.station, event.event) for event in master_log.events)
    for station, changes in _status_changes(master_log).items():
        count = events[station, "instrument_status"]
        if count != changes:
            yield f"station {station}: {count} events of its instrument's status, which has changed {changes} times"
    yield from _wrongly_lost(master_log, LOST_S if superframe else CLASSIC_LOST_S)
    yield from _wrong_batteries(master_log)


def _status_changes(master_log: MasterLog) -> Counter[int]:
    """Return how often each station's instrument has changed its status; usable ones count as one."""
    newest: dict[int, tuple[int, int]] = {}
    last: dict[int, Status] = {}
    without_distance_ns: dict[int, int] = {}  # since when
    changes: Counter[int] = Counter()
    for measurement in master_log.measurements:
        station = measurement.station
        changes[station] += 0
        sequence, stamp_ns = newest.get(station, (-1, 0))
        continued = sequence <= measurement.sequence <= sequence + MAX_SEQUENCE_STEP
        if measurement.stamp_ns < stamp_ns and not continued:
            continue  # a backlog: out of date
        newest[station] = measurement.sequence, measurement.stamp_ns
        if measurement.status is not Status.ANGLE_ONLY:
            without_distance_ns.pop(station, None)
        elif (
            without_distance_ns.setdefault(station, measurement.stamp_ns)
            > measurement.stamp_ns - NO_DISTANCE_NS
        ):
            continue
        status = Status.OK if measurement.status.usable else measurement.status
        changes[station] += status != last.get(station, Status.OK)
        last[station] = status
    return changes


def _wrongly_lost(master_log: MasterLog, lost_s: float) -> Iterator[str]:
    reported: set[int] = set()
    for status, lost in _with_events(master_log, "station_lost", "station_recovered"):
        for station in status.stations:
            heard_s, is_lost = station.last_heard_s, station.id in lost
            if heard_s is None or station.id in reported:
                continue
            if (heard_s > lost_s and not is_lost) or (heard_s < HEARD_S and is_lost):
                reported.add(station.id)
                yield (
                    f"station {station.id}: last heard {heard_s:.1f} s before the status at "
                    f"{_at_s(master_log, status):.1f} s, by the events it is {'lost' if is_lost else 'not lost'}"
                )


def _wrong_batteries(master_log: MasterLog) -> Iterator[str]:
    reported: set[int] = set()
    for status, low in _with_events(master_log, "battery_low", "battery_recovered"):
        for station in status.stations:
            percent, is_low = station.battery_percent, station.id in low
            if percent is None or station.id in reported:
                continue
            if (percent < LOW_BATTERY_PERCENT and not is_low) or (
                percent >= CHARGED_BATTERY_PERCENT and is_low
            ):
                reported.add(station.id)
                yield (
                    f"station {station.id}: {percent} % in its battery by the status at {_at_s(master_log, status):.1f} s, "
                    f"by the events it is {'low' if is_low else 'not low'}"
                )


def _with_events(
    master_log: MasterLog, begins: str, ends: str
) -> Iterator[tuple[StatusRecord, set[int | None]]]:
    """Yield each status with the stations in the state that one event begins and another one ends."""
    changes = [event for event in master_log.events if event.event in (begins, ends)]
    inside: set[int | None] = set()
    at = 0
    for status in master_log.statuses:
        while at < len(changes) and changes[at].stamp_ns <= status.stamp_ns:
            if changes[at].event == begins:
                inside.add(changes[at].station)
            else:
                inside.discard(changes[at].station)
            at += 1
        yield status, inside


def _at_s(master_log: MasterLog, status: StatusRecord) -> float:
    return (status.stamp_ns - master_log.unix_at_zero_ns) / 1e9
