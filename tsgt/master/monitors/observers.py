"""The observers of the publisher: which poses the layout monitor gets, and what follows from a crossed geofence."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tsgt.errors import DegenerateGeometryError
from tsgt.estimation import LiveEstimator
from tsgt.master.monitors.geofence import Geofence, run_geofence_command
from tsgt.master.monitors.layout import LayoutMonitor
from tsgt.master.publisher import Observer
from tsgt.recording import PoseRecord

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Sequence

    from tsgt.config import FrameWatchConfig, GeofenceConfig
    from tsgt.model import Measurement, Parameters
    from tsgt.recording import EventRecord

SILENCE_NS = 5_000_000_000
"""Poses are computed when a measurement arrives, but after such a silence without one: those of hours would block the master."""


def layout_monitor(config: FrameWatchConfig, parameters: Parameters) -> Observer:
    """Return the layout monitor, with the poses that it can judge."""
    monitor = LayoutMonitor(config, parameters.pipeline.period_ns)
    if parameters.pipeline.estimator == "linear":
        return monitor
    try:
        return _LinearPoses(monitor, parameters)
    except DegenerateGeometryError:  # one or two prisms, or all in a line, and an IMU
        return _FinalPoses(monitor)


class _FinalPoses(Observer):
    """Gives an observer the final poses only. Unlike without an IMU, their trajectory does not give way to wrong prisms."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer

    def pose(self, record: PoseRecord, now_ns: int) -> Sequence[EventRecord]:
        final = record.kind == "smoothed" and record.delay_s is None
        return self._observer.pose(record, now_ns) if final else []


class _LinearPoses(Observer):
    """Gives an observer the poses of the estimator ``linear`` instead of the published ones."""

    def __init__(self, observer: Observer, parameters: Parameters) -> None:
        self._observer = observer
        pipeline = replace(parameters.pipeline, estimator="linear")
        self._estimator = LiveEstimator(replace(parameters, pipeline=pipeline))
        self._advanced_ns: int | None = None

    def measurement(self, record: Measurement) -> Sequence[EventRecord]:
        self._advanced_ns = record.received_ns
        return self._events(self._estimator.measurement(record), record.received_ns)

    def tick(self, now_ns: int) -> Sequence[EventRecord]:
        deadline_ns = self.next_deadline_ns()
        if deadline_ns is None or now_ns < deadline_ns:
            return ()
        self._advanced_ns = now_ns
        return self._events(self._estimator.advance(now_ns), now_ns)

    def next_deadline_ns(self) -> int | None:
        return None if self._advanced_ns is None else self._advanced_ns + SILENCE_NS

    def _events(self, records: Sequence[object], now_ns: int) -> Sequence[EventRecord]:
        poses = (record for record in records if isinstance(record, PoseRecord))
        return [event for pose in poses for event in self._observer.pose(pose, now_ns)]


class GeofenceObserver(Observer):
    """A geofence and the command that runs when it is crossed."""

    def __init__(self, config: GeofenceConfig, group: asyncio.TaskGroup) -> None:
        self._geofence = Geofence(config)
        self._config = config
        self._group = group

    def pose(self, record: PoseRecord, now_ns: int) -> Sequence[EventRecord]:
        """Take a pose; return and act on the events that follow."""
        return self._run_command(self._geofence.pose(record, now_ns))

    def tick(self, now_ns: int) -> Sequence[EventRecord]:
        """Return and act on the event of a robot without a valid pose for too long."""
        return self._run_command(self._geofence.tick(now_ns))

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`tick` has to be called."""
        return self._geofence.next_deadline_ns()

    def _run_command(self, events: Sequence[EventRecord]) -> Sequence[EventRecord]:
        if self._config.command:
            for event in events:
                command = run_geofence_command(
                    self._config.command, event=event.event, fence=self._config.name
                )
                try:
                    self._group.create_task(command)
                except RuntimeError:  # the task group is shutting down
                    command.close()
        return events
