"""Everything that leaves the master, in one order: to the readers of the stream, into the recording, to the watchers.

What a line says of an instant stands behind all poses that were due by then. A replay makes the same calls with the
same instants, so it gives the same lines bit for bit.

Where the protocols of the radio report to: one place for what goes out, what is counted, and what is worth an event.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from tsgt.estimation import Feed
from tsgt.model import PolarMeasurement
from tsgt.recording import EventRecord, PoseRecord, encode_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.master.station_events import Alerts
    from tsgt.master.statistics import Monitor
    from tsgt.model import Measurement, Parameters
    from tsgt.recording import BeaconRecord, ClockRecord, StatusRecord


class Watcher(Protocol):
    """Looks at what goes out, and may have an event to add."""

    def pose(self, record: PoseRecord, now_ns: int) -> Sequence[EventRecord]:
        """Take a pose that came out at an instant."""
        ...

    def measurement(self, record: Measurement) -> Sequence[EventRecord]:
        """Take a measurement that has come."""
        ...

    def tick(self, now_ns: int) -> Sequence[EventRecord]:
        """Notice what time alone has brought."""
        ...

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`tick` has to be called; None while nothing runs out."""
        ...


class Outlet:
    """Turns what happens into lines, puts them in order and hands them out.

    Parameters
    ----------
    parameters
        Stations, prisms and limits in force.
    monitor
        Counts what goes out.
    watchers
        Asked about each pose.
    hand_out
        Takes each record with its line.
    """

    def __init__(
        self,
        parameters: Parameters,
        monitor: Monitor,
        watchers: Sequence[Watcher],
        hand_out: Callable[[object, bytes], None],
    ) -> None:
        self._feed = Feed(parameters)
        self._monitor = monitor
        self._watchers = watchers
        self._hand_out = hand_out
        self._changed = asyncio.Event()

    def measurement(self, measurement: Measurement) -> None:
        """Send a measurement, and the poses that it completes."""
        self._send(self._feed.measurement(measurement), measurement.received_ns)

    def put(self, record: StatusRecord | EventRecord | ClockRecord | BeaconRecord) -> None:
        """Send a record in its place, after the poses that are due by its stamp."""
        self._send([*self._feed.advance(record.stamp_ns), record], record.stamp_ns)

    def advance(self, now_ns: int) -> None:
        """Send the poses that are due by now, and what the watchers make of the time."""
        self._send(self._feed.advance(now_ns), now_ns)
        for watcher in self._watchers:
            for event in watcher.tick(now_ns):
                self.put(event)

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`advance` has to be called if nothing happens before."""
        deadlines_ns = [self._feed.next_deadline_ns(), *(w.next_deadline_ns() for w in self._watchers)]
        return min((deadline_ns for deadline_ns in deadlines_ns if deadline_ns is not None), default=None)

    async def changed(self) -> None:
        """Return when something has been sent since the last call, so that the next deadline may be another."""
        await self._changed.wait()
        self._changed.clear()

    def _send(self, records: Sequence[object], now_ns: int) -> None:
        events: list[EventRecord] = []
        for record in records:
            self._hand_out(record, encode_line(record))
            if isinstance(record, PoseRecord):
                if record.kind != "smoothed":  # each of them has been there before, predicted
                    self._monitor.pose(valid=record.valid)
                for watcher in self._watchers:
                    events += watcher.pose(record, now_ns)
            elif isinstance(record, PolarMeasurement):
                self._monitor.measurement(record)
                for watcher in self._watchers:
                    events += watcher.measurement(record)
        outside_lag_window = self._feed.outside_lag_window()
        if outside_lag_window is not None:
            self._monitor.outside_lag_window(outside_lag_window)
        for event in events:
            self.put(event)
        self._changed.set()


@dataclass(frozen=True, slots=True)
class Reports:
    """What a link reports to.

    Attributes
    ----------
    clock, timeline
        The master's time, and where it lies in Unix time.
    outlet
        Takes all that leaves the master.
    monitor
        Counts for the status lines.
    alerts
        Turns findings into events.
    """

    clock: Clock
    timeline: UnixTimeline
    outlet: Outlet
    monitor: Monitor
    alerts: Alerts

    def now_ns(self) -> int:
        """Return the present on the master's Unix clock, as its stream has it."""
        return self.timeline.unix_ns(self.clock.monotonic_ns())

    def measured(self, measurement: PolarMeasurement) -> None:
        """Hand on a measurement that is new."""
        self.outlet.measurement(measurement)
        self.events(self.alerts.measurement(measurement, self.now_ns()))

    def events(self, events: Iterable[EventRecord]) -> None:
        """Hand on events."""
        for event in events:
            self.outlet.put(event)

    def event(self, name: str, message: str, station: int | None = None) -> None:
        """Hand on an event that happens now."""
        self.events([EventRecord(stamp_ns=self.now_ns(), event=name, message=message, station=station)])
