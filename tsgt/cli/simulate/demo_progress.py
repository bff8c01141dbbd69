"""Progress of a demonstration on stderr: poses, their errors, and the state of each station."""

from __future__ import annotations

import math
import sys
import time
from array import array
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import click
import numpy as np

from tsgt.analysis.evaluation import LivePoseErrors, LivePoses, interior_mask, newest_age_s
from tsgt.cli.live import station_label
from tsgt.estimation import centroid_at_point, point_label, sigma_limits_of, transform_of
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.recording import EventRecord, PoseRecord, StatusRecord, decode

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.live import Live

    from tsgt.clock import UnixTimeline
    from tsgt.simulation.demo import Demo

PRINT_INTERVAL_S = 5.0
"""Interval between status blocks without a terminal."""

_BATCH_POSES = 100
"""A day has 3.5 million poses: each is compared once, and only its stamp and errors are kept."""


@dataclass(slots=True)
class _ValidPoses:
    """Valid poses of one series: the newest, those to compare with the truth, and the errors of the others."""

    newest: PoseRecord | None = None
    waiting: list[tuple[PoseRecord, float]] = field(default_factory=list)  # with their ages in s
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    errors: list[LivePoseErrors] = field(default_factory=list)


class Progress:
    """Compares the poses of a demonstration with the truth, and shows the result with each status of the master.

    Parameters
    ----------
    timeline
        From CLOCK_MONOTONIC of the truth to Unix time of the poses.

    Attributes
    ----------
    poses
        Number of poses by series, valid or not.
    first_ns, last_ns
        Unix time of the first and the last pose in ns; 0 before.
    """

    def __init__(self, demo: Demo, timeline: UnixTimeline) -> None:
        self._demo = demo
        self._timeline = timeline
        self._start_ns = timeline.unix_ns(demo.start_ns)
        self._valid: defaultdict[str, _ValidPoses] = defaultdict(_ValidPoses)
        self._live: Live | None = None
        self._printed_at_s = 0.0
        self._starts = 0
        self.poses: Counter[str] = Counter()
        self.first_ns = 0
        self.last_ns = 0

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            console = Console(file=sys.stderr, markup=False, highlight=False)
            self._live = Live(console=console, auto_refresh=False)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def line(self, line: bytes) -> None:
        """Process a line of the master's stream."""
        if line.startswith(b'{"type":"pose"'):
            self._pose(decode(PoseRecord, line))
        elif line.startswith(b'{"type":"status"'):
            self._status(decode(StatusRecord, line))
        elif line.startswith(b'{"type":"event"'):
            event = decode(EventRecord, line)
            self._print(f"event  {event.event}: {event.message}")

    @property
    def best(self) -> str:
        """The series of poses to report: the best that the estimator makes."""
        return next((series for series in ("smoothed", "predicted") if self.poses[series]), "interpolated")

    def live_poses(self, series: str) -> LivePoses:
        """Return the poses of a series so far, with the errors of the valid ones, without 2 s at both ends."""
        stamps_ns, errors = self._compared(series)
        inner = interior_mask(stamps_ns, self.first_ns, self.last_ns)
        limits = sigma_limits_of(series, self._demo.parameters.pipeline)
        return LivePoses(
            self.poses[series], len(stamps_ns), errors.age_s, errors.select(inner).statistics(*limits)
        )

    def _compared(self, series: str) -> tuple[NDArray[np.int64], LivePoseErrors]:
        """Return stamps and errors of all valid poses of a series, in the order of the stream."""
        self._compare_waiting(series)
        valid = self._valid[series]
        valid.errors = [LivePoseErrors.concatenated(valid.errors)]
        return np.array(valid.stamps_ns, dtype=np.int64), valid.errors[0]

    def _compare_waiting(self, series: str) -> None:
        """Compare the waiting poses with the truth."""
        valid = self._valid[series]
        waiting, valid.waiting = valid.waiting, []
        poses = [pose for pose, _ in waiting]
        stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
        positions = np.array([pose.position_m for pose in poses], dtype=np.float64).reshape(-1, 3)
        quaternions = np.array([pose.orientation_xyzw for pose in poses], dtype=np.float64).reshape(-1, 4)
        parameters = self._demo.parameters
        truth = self._demo.world.pose_at((stamps_ns - self._start_ns) / 1e9)
        errors = LivePoseErrors.of(
            transform_from(rotation_from_quaternion(quaternions), positions),
            np.array([pose.covariance for pose in poses], dtype=np.float64).reshape(-1, 6, 6),
            np.array([age_s for _, age_s in waiting]),
            truth @ transform_of(parameters.reference_point),
            centroid_at_point(parameters),
        )
        valid.stamps_ns.extend(stamps_ns.tolist())
        valid.errors.append(errors)

    def _pose(self, pose: PoseRecord) -> None:
        self.first_ns = self.first_ns or pose.stamp_ns
        self.last_ns = max(self.last_ns, pose.stamp_ns)
        self.poses[pose.series] += 1
        if pose.valid:
            valid = self._valid[pose.series]
            valid.newest = pose
            sent_s = (self._timeline.unix_ns(time.monotonic_ns()) - pose.stamp_ns) / 1e9
            valid.waiting.append((pose, newest_age_s(pose) if pose.kind == "predicted" else sent_s))
            if len(valid.waiting) == _BATCH_POSES:
                self._compare_waiting(pose.series)

    def _status(self, status: StatusRecord) -> None:
        starts = sum(process.starts for process in self._demo.processes)
        if starts != self._starts:
            self._starts = starts
            pids = "  ".join(f"{p.name}: {p.pid or 'down'}" for p in self._demo.processes)
            self._print(f"processes  {pids}")
        now_s = time.monotonic()
        if self._live is None and now_s - self._printed_at_s < PRINT_INTERVAL_S:
            return
        self._printed_at_s = now_s
        elapsed_s = (status.stamp_ns - self._start_ns) / 1e9
        newest = self._valid[self.best].newest
        text = f"{elapsed_s:5.0f} s"
        at = point_label(self._demo.parameters.reference_point)
        if newest is not None:
            position = " ".join(f"{value:6.2f}" for value in newest.position_m or ())
            text += f"  {at} at {position} m"
        lines = [text]
        for series in sorted(self.poses):
            keys = self.live_poses(series).keys()
            line = f"         {series:<12} {keys['valid_poses']}/{keys['poses']} poses valid  "
            line += f"{'newest measurement' if series == 'predicted' else 'sent'} {keys['age_ms']['p50']:.0f} ms old"
            if math.isfinite(keys["position_rms_mm"]):
                line += f"  rms error {keys['position_rms_mm']:.1f} mm at {at}, {keys['orientation_rms_deg']:.2f} deg"
            lines.append(line)
        for station in status.stations:
            label, _ = station_label(station)
            rate = "" if station.rate_hz is None else f"  {station.rate_hz:.2f} Hz"
            strength = "" if station.rssi_dbm is None else f"  {station.rssi_dbm:.0f} dBm"
            bounds_ns = {"clock": station.clock_bound_ns, "timestamp": station.stamp_bound_ns}
            bound = next(
                (f"  {of} bound {ns / 1e6:.2f} ms" for of, ns in bounds_ns.items() if ns is not None), ""
            )
            lines.append(f"         station {station.id}  {label}{rate}{strength}{bound}")
        if self._live is None:
            click.echo("\n".join(lines), err=True)
        else:
            self._live.update(_block(lines), refresh=True)

    def _print(self, text: str) -> None:
        """Print a line that stays, above the status block."""
        if self._live is None:
            click.echo(text, err=True)
        else:
            self._live.console.print(text)


def _block(lines: list[str]) -> Any:
    """Return a block of lines that are cut at the width of the terminal."""
    from rich.text import Text

    return Text("\n".join(lines), no_wrap=True, overflow="crop")
