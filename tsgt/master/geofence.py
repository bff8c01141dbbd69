"""The geo-fence: tells when the robot leaves an area, or may have left it, and when it is back.

Pure: poses and instants come in, events go out. A fence is armed by the first valid pose. From then on the robot
counts as gone in two cases, each of which is enough: its position, at as many standard deviations as configured,
lies on the wrong side of the boundary; or nobody has known for a while where it is.

Runs the command that a geo-fence is configured with.
"""

from __future__ import annotations

import asyncio
import math
import os
import signal
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

import structlog

from tsgt.polygon import contains, distance_to_edge, edges
from tsgt.recording import EventRecord

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import Measurement
    from tsgt.polygon import Point
    from tsgt.recording import PoseRecord


class FenceSettings(Protocol):
    """What a fence needs to know: ``tsgt.config.GeofenceConfig`` in its units, which this core may not import."""

    @property
    def name(self) -> str:
        """Its name in events."""

    @property
    def keep(self) -> str:
        """``inside`` or ``outside``: where the robot belongs."""

    @property
    def polygon_m(self) -> Sequence[Point]:
        """Corners [x, y] in order, in the frame ``station1``; a simple polygon."""

    @property
    def margin_m(self) -> float:
        """The robot has to stay this far on the right side."""

    @property
    def sigmas(self) -> float:
        """How many standard deviations of the position count."""

    @property
    def hysteresis_m(self) -> float:
        """It is back only this much further on the right side."""

    @property
    def lost_after_s(self) -> float:
        """No valid pose for this long counts as leaving."""


class Geofence:
    """Watches one area.

    Parameters
    ----------
    settings
        The area and its limits.
    """

    def __init__(self, settings: FenceSettings) -> None:
        self.name = settings.name
        self._settings = settings
        self._edges = edges(settings.polygon_m)
        self._lost_after_ns = round(settings.lost_after_s * 1e9)
        self._last_valid_ns: int | None = None
        self._beyond = False
        self._lost = False

    def pose(self, record: PoseRecord, now_ns: int) -> list[EventRecord]:
        """Take a pose, valid or not, that came out at ``now_ns``; return what it changed.

        Smoothed poses are passed over: they tell where the robot was.
        """
        events = self.tick(now_ns)
        if (
            record.kind == "smoothed"
            or not record.valid
            or record.position_m is None
            or record.covariance is None
        ):
            return events
        self._last_valid_ns = now_ns
        gone_before = self._beyond or self._lost
        x, y, _ = record.position_m
        spare_m = self._spare_m((x, y), record.covariance)
        self._beyond = spare_m < (self._settings.hysteresis_m if self._beyond else 0.0)
        self._lost = False
        if self._beyond == gone_before:
            return events
        what = f"{abs(spare_m):.2f} m {'beyond' if spare_m < 0 else 'within'} its limit at x {x:.2f}, y {y:.2f} m"
        if self._beyond:
            return [
                *events,
                self._event(now_ns, "geofence_exited", f"fence {self.name} left: the robot is {what}"),
            ]
        return [
            *events,
            self._event(now_ns, "geofence_entered", f"fence {self.name} entered: the robot is {what}"),
        ]

    def measurement(self, record: Measurement) -> list[EventRecord]:  # noqa: ARG002 (poses tell where the robot is)
        """Take a measurement, which says nothing here."""
        return []

    def tick(self, now_ns: int) -> list[EventRecord]:
        """Notice that no valid pose has come for too long."""
        deadline_ns = self.next_deadline_ns()
        if deadline_ns is None or now_ns < deadline_ns:
            return []
        self._lost = True
        if self._beyond:
            return []
        message = f"fence {self.name} left: no valid pose for {self._settings.lost_after_s:g} s"
        return [self._event(now_ns, "geofence_exited", message)]

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`tick` is to be called if no valid pose comes before; None while nothing runs out."""
        if self._last_valid_ns is None or self._lost:
            return None
        return self._last_valid_ns + self._lost_after_ns

    def _spare_m(self, point: Point, covariance: Sequence[float]) -> float:
        """Return how far the robot may still go, at the stated number of standard deviations; negative: beyond.

        Every edge counts with the uncertainty in its own direction: one further off is the nearer one if the
        position is poor that way.
        """
        xx, xy, _, _, _, _, _, yy, *_ = covariance
        ways = [
            (distance, self._settings.sigmas * math.sqrt(max(u * u * xx + 2 * u * v * xy + v * v * yy, 0.0)))
            for distance, (u, v) in (distance_to_edge(point, edge) for edge in self._edges)
        ]
        on_right_side = contains(self._settings.polygon_m, point) == (self._settings.keep == "inside")
        spare_m = (
            min(d - unsure for d, unsure in ways) if on_right_side else -min(d + unsure for d, unsure in ways)
        )
        return spare_m - self._settings.margin_m

    @staticmethod
    def _event(now_ns: int, event: str, message: str) -> EventRecord:
        # Stamped when it is noticed, not with the pose: a replay puts it after the poses that were due by then.
        return EventRecord(stamp_ns=now_ns, event=event, message=message)


TIMEOUT_S = 10.0
"""How long it may take before it is killed, with what it has started."""

KILL_TIMEOUT_S = 0.5
"""How long is waited for it to be gone then: one that may not be killed must not keep the master from ending."""

log = structlog.get_logger()


async def run_fence_command(command: Sequence[str], *, event: str, fence: str) -> None:
    """Run a command at a crossing; what becomes of it is told in the log, and nowhere else.

    Parameters
    ----------
    command
        Program and arguments.
    event, fence
        Put into its environment as ``TSGT_EVENT`` and ``TSGT_FENCE``.
    """
    problem = await _problem(command, os.environ | {"TSGT_EVENT": event, "TSGT_FENCE": fence})
    if problem:
        log.error("fence_command_failed", fence=fence, command=command[0], error=problem)
    else:
        log.info("fence_command_done", fence=fence, command=command[0])


async def _problem(command: Sequence[str], environment: dict[str, str]) -> str:
    """Run it; say what went wrong, or nothing."""
    environment.pop("NOTIFY_SOCKET", None)  # it is not a part of the service, and must not speak for it
    try:
        process = await asyncio.create_subprocess_exec(
            *command,
            env=environment,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            start_new_session=True,
        )
    except (OSError, ValueError) as error:  # ValueError: a zero byte among the arguments
        return f"cannot be started ({error})"
    try:
        async with asyncio.timeout(TIMEOUT_S):
            status = await process.wait()
    except TimeoutError:
        return f"killed after {TIMEOUT_S:g} s"
    else:
        return f"exit status {status}" if status else ""
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError, PermissionError):  # it may have become another user's
                os.killpg(process.pid, signal.SIGKILL)
            with suppress(TimeoutError):
                async with asyncio.timeout(KILL_TIMEOUT_S):
                    await process.wait()
