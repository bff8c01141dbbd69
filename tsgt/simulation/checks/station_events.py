"""Events of the stations against measurements and status: of an instrument's status, and of stations that are lost."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from tsgt.model import Status

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.simulation.mission import MasterLog

LOST_S = 20.0
"""A station that has not been heard for longer must have been reported as lost: that takes 5 s, while it is polled or has slots."""

CLASSIC_LOST_S = 80.0
"""The same over ``classic``, which polls nobody while it synchronises three stations, for up to a minute."""

HEARD_S = 0.5
"""A station that was heard less than this ago must have been reported as recovered."""


def event_failures(master_log: MasterLog, *, superframe: bool) -> Iterator[str]:
    """Yield the stations of which events are missing, or were not called for."""
    events = Counter((event.station, event.event) for event in master_log.events)
    for station, changes in _status_changes(master_log).items():
        count = events[station, "instrument_status"]
        if count != changes:
            yield f"station {station}: {count} events of its instrument's status, which has changed {changes} times"
    yield from _wrongly_lost(master_log, LOST_S if superframe else CLASSIC_LOST_S)


def _status_changes(master_log: MasterLog) -> Counter[int]:
    """Return how often each station's instrument has changed its status; usable ones count as one."""
    newest: dict[int, tuple[int, int]] = {}
    last: dict[int, Status] = {}
    changes: Counter[int] = Counter()
    for measurement in master_log.measurements:
        station = measurement.station
        changes[station] += 0
        sequence, stamp_ns = newest.get(station, (-1, 0))
        if measurement.sequence < sequence and measurement.stamp_ns < stamp_ns:
            continue  # a backlog: out of date
        newest[station] = measurement.sequence, measurement.stamp_ns
        status = Status.OK if measurement.status.usable else measurement.status
        changes[station] += status != last.get(station, Status.OK)
        last[station] = status
    return changes


def _wrongly_lost(master_log: MasterLog, lost_s: float) -> Iterator[str]:
    changes = [event for event in master_log.events if event.event in ("station_lost", "station_recovered")]
    lost: dict[int | None, bool] = {}
    reported: set[int] = set()
    at = 0
    for status in master_log.statuses:
        while at < len(changes) and changes[at].stamp_ns <= status.stamp_ns:
            lost[changes[at].station] = changes[at].event == "station_lost"
            at += 1
        for station in status.stations:
            heard_s = station.last_heard_s
            if heard_s is None or station.id in reported:
                continue
            is_lost = lost.get(station.id, False)
            if (heard_s > lost_s and not is_lost) or (heard_s < HEARD_S and is_lost):
                reported.add(station.id)
                yield (
                    f"station {station.id}: last heard {heard_s:.1f} s before the status at "
                    f"{(status.stamp_ns - master_log.unix_at_zero_ns) / 1e9:.1f} s, by the events it is "
                    f"{'lost' if is_lost else 'not lost'}"
                )
