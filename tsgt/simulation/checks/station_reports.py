"""What the master's status says of stations and of the recording's disk, against the clients and what happened afterwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.recording import StationStatus
    from tsgt.simulation.mission import MasterLog, MissionResult

DRAIN_WINDOW_NS, MIN_DRAIN_SPAN_NS = 60_000_000_000, 10_000_000_000
"""The drain rate is that over the last minute; none is stated over less than ten seconds."""

FIRST_STATUSES = 3
"""The window begins with one of its first statuses: they come a little more often than samples are kept."""

_DRAIN_TOLERANCE_HZ = 1e-6

WRITING_STATUSES = 3
"""A disk that has taken lines between as many successive statuses is not full."""


def report_failures(result: MissionResult) -> Iterator[str]:
    """Yield stations whose battery or drain rate is wrong, and disks that are written but reported as full."""
    for master_log in result.master_logs:
        yield from _drain_failures(master_log)
        yield from _disk_failures(master_log)
    last = result.master_logs[-1].statuses[-1:]
    for station in (station for status in last for station in status.stations):
        station_log, stated = result.station_logs[station.id], station.battery_percent
        # A status report comes every few seconds: what the client reads at the very end need not arrive.
        clients = [*station_log.statuses[-1:], station_log.reportable_status]
        known = {each.battery_percent for each in clients if each is not None}
        if known and stated is not None and not known & {None, stated}:
            yield f"station {station.id}: the status ends with a battery of {stated} %, its client with {known} %"


def _drain_failures(master_log: MasterLog) -> Iterator[str]:
    samples: dict[int, list[tuple[int, StationStatus]]] = {}
    for status in master_log.statuses:
        for station in status.stations:
            if not station.joined or station.outstanding is None:
                continue
            window = samples.setdefault(station.id, [])
            window.append((status.stamp_ns, station))
            while window[0][0] <= status.stamp_ns - DRAIN_WINDOW_NS:
                window.pop(0)
            if station.drain_rate_hz is None:
                continue
            possible = [
                (before.outstanding - station.outstanding) / ((status.stamp_ns - stamp_ns) / 1e9)
                for stamp_ns, before in window[:FIRST_STATUSES]
                if before.outstanding is not None and status.stamp_ns - stamp_ns >= MIN_DRAIN_SPAN_NS
            ]
            if not any(abs(station.drain_rate_hz - each) <= _DRAIN_TOLERANCE_HZ for each in possible):
                at_s = (status.stamp_ns - master_log.unix_at_zero_ns) / 1e9
                yield (
                    f"status at {at_s:.3f} s: station {station.id} drains at {station.drain_rate_hz:.3f} Hz, "
                    f"by what was outstanding at {', '.join(f'{each:.3f}' for each in possible) or 'an unknown rate'}"
                )
                return


def _disk_failures(master_log: MasterLog) -> Iterator[str]:
    events = [event for event in master_log.events if event.event.startswith("disk_")]
    state, at, written, size = "", 0, 0, 0
    for status in master_log.statuses:
        if status.recording is None:
            continue
        # Statuses come before the events that are detected with them.
        while at < len(events) and events[at].stamp_ns <= status.stamp_ns:
            state, written, at = events[at].event, 0, at + 1
        written = written + 1 if status.recording.bytes > size and not status.recording.waiting_lines else 0
        size = status.recording.bytes
        if state in ("disk_full", "disk_failed") and written > WRITING_STATUSES:
            at_s = (status.stamp_ns - master_log.unix_at_zero_ns) / 1e9
            yield f"status at {at_s:.3f} s: the recording is written, but the last event of its disk is {state}"
            return
