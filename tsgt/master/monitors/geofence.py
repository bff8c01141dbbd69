"""Geofences: detects when the robot exits or enters an area, and runs the configured command.

A geofence is armed by the first valid pose. From then on the robot is outside its allowed side when its position, at the
configured number of standard deviations, is beyond the boundary, or when there was no valid pose for a while.
:class:`Geofence` is sans-I/O.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import structlog

from tsgt.master.publisher import Observer
from tsgt.polygon import contains, distance_to_edge, edges
from tsgt.recording import EventRecord
from tsgt.service import run_command

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.config import GeofenceConfig
    from tsgt.polygon import Point
    from tsgt.recording import PoseRecord


class Geofence(Observer):
    """Monitors one area."""

    def __init__(self, settings: GeofenceConfig) -> None:
        self.name = settings.name
        self._settings = settings
        self._edges = edges(settings.polygon_m)
        self._lost_after_ns = round(settings.lost_after_s * 1e9)
        self._last_valid_ns: int | None = None
        self._beyond = False
        self._lost = False

    def pose(self, record: PoseRecord, now_ns: int) -> list[EventRecord]:
        """Take a pose published at ``now_ns``; return the events that follow. Smoothed poses, of the past, are ignored."""
        events = self.tick(now_ns)
        if (
            record.kind == "smoothed"
            or not record.valid
            or record.position_m is None
            or record.covariance is None
        ):
            return events
        self._last_valid_ns = now_ns
        was_outside = self._beyond or self._lost
        x, y, _ = record.position_m
        clearance_m = self._clearance_m((x, y), record.covariance)
        self._beyond = clearance_m < (self._settings.hysteresis_m if self._beyond else 0.0)
        self._lost = False
        if self._beyond == was_outside:
            return events
        side = "beyond" if clearance_m < 0 else "within"
        change = "exited" if self._beyond else "entered"
        message = (
            f"geofence {self.name} {change}: the robot is {abs(clearance_m):.2f} m {side} its limit "
            f"at x {x:.2f}, y {y:.2f} m"
        )
        return [*events, EventRecord(stamp_ns=now_ns, event=f"geofence_{change}", message=message)]

    def tick(self, now_ns: int) -> list[EventRecord]:
        """Return the event of a robot without a valid pose for too long."""
        deadline_ns = self.next_deadline_ns()
        if deadline_ns is None or now_ns < deadline_ns:
            return []
        self._lost = True
        if self._beyond:
            return []
        # Stamped when it is detected, not with the pose: a replay puts it after the poses that were due by then.
        message = f"geofence {self.name} exited: no valid pose for {self._settings.lost_after_s:g} s"
        return [EventRecord(stamp_ns=now_ns, event="geofence_exited", message=message)]

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`tick` has to be called without a valid pose before; None while no time-out is running."""
        if self._last_valid_ns is None or self._lost:
            return None
        return self._last_valid_ns + self._lost_after_ns

    def _clearance_m(self, point: Point, covariance: Sequence[float]) -> float:
        """Return the least distance to the edges, each less margin and its own uncertainty; negative: beyond."""
        xx, xy, _, _, _, _, _, yy, *_ = covariance
        distances = [
            (distance, self._settings.sigmas * math.sqrt(max(u * u * xx + 2 * u * v * xy + v * v * yy, 0.0)))
            for distance, (u, v) in (distance_to_edge(point, edge) for edge in self._edges)
        ]
        on_allowed_side = contains(self._settings.polygon_m, point) == (
            self._settings.allowed_side == "inside"
        )
        clearance_m = (
            min(d - uncertainty for d, uncertainty in distances)
            if on_allowed_side
            else -min(d + uncertainty for d, uncertainty in distances)
        )
        return clearance_m - self._settings.margin_m


log = structlog.get_logger()


async def run_geofence_command(command: Sequence[str], *, event: str, fence: str) -> None:
    """Run a command with ``TSGT_EVENT`` and ``TSGT_FENCE`` in its environment, and log its outcome."""
    problem = await run_command(command, {"TSGT_EVENT": event, "TSGT_FENCE": fence})
    if problem:
        log.error("fence_command_failed", fence=fence, command=command[0], error=problem)
    else:
        log.info("fence_command_done", fence=fence, command=command[0])
