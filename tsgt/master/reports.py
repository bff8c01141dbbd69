"""Where the protocols of the radio report to: one place for what goes out, what is counted, and what is worth an event."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.master.stream_records import EventRecord

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.master.alerts import Alerts
    from tsgt.master.monitor import Monitor
    from tsgt.master.outlet import Outlet
    from tsgt.model import PolarMeasurement


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
