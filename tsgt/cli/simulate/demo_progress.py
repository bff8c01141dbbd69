"""Progress of a demonstration on stderr: poses, their errors, and the state of each station."""

from __future__ import annotations

import sys
import time
from array import array
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import click
import numpy as np

from tsgt.analysis.evaluation import PoseErrors, pose_errors
from tsgt.cli.status import station_label
from tsgt.estimation import centroid_at_point, point_label, transform_of
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.recording import EventRecord, PoseRecord, StatusRecord, decode

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.live import Live

    from tsgt.clock import UnixTimeline
    from tsgt.recording import Kind
    from tsgt.simulation.demo import Demo

PRINT_INTERVAL_S = 5.0
"""Interval between status blocks without a terminal."""

_BATCH_POSES = 100
"""A day has 3.5 million poses: each is compared once, and only its stamp and errors are kept."""


@dataclass(slots=True)
class _ValidPoses:
    """Valid poses of one kind: the newest, those to compare with the truth, and the errors of the others."""

    newest: PoseRecord | None = None
    waiting: list[PoseRecord] = field(default_factory=list)
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    position_m: array[float] = field(default_factory=lambda: array("d"))
    centroid_m: array[float] = field(default_factory=lambda: array("d"))
    rotation_rad: array[float] = field(default_factory=lambda: array("d"))


class Progress:
    """Compares the poses of a demonstration with the truth, and shows the result with each status of the master.

    Parameters
    ----------
    timeline
        From CLOCK_MONOTONIC of the truth to Unix time of the poses.

    Attributes
    ----------
    poses
        Number of poses by kind, valid or not.
    first_ns, last_ns
        Unix time of the first and the last pose in ns; 0 before.
    """

    def __init__(self, demo: Demo, timeline: UnixTimeline) -> None:
        self._demo = demo
        self._start_ns = timeline.unix_ns(demo.start_ns)
        self._valid: defaultdict[Kind, _ValidPoses] = defaultdict(_ValidPoses)
        self._live: Live | None = None
        self._printed_at_s = 0.0
        self._starts = 0
        self.poses: Counter[Kind] = Counter()
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
    def kind(self) -> Kind:
        """The kind of poses to report: the best that the estimator makes."""
        return "smoothed" if self.poses["predicted"] else "interpolated"

    def valid_stamps_ns(self, kind: Kind) -> NDArray[np.int64]:
        """Return the Unix times of the valid poses of a kind in ns."""
        return np.array(self._compared(kind).stamps_ns, dtype=np.int64)

    def errors(self, kind: Kind, mask: NDArray[np.bool_] | None = None) -> PoseErrors:
        """Return the errors of the valid poses of a kind: of all, or of those in the mask."""
        compared = self._compared(kind)
        chosen = slice(None) if mask is None else mask
        columns = (compared.position_m, compared.centroid_m, compared.rotation_rad)
        return PoseErrors(*(np.array(column)[chosen] for column in columns))

    def _compared(self, kind: Kind) -> _ValidPoses:
        """Compare the waiting poses with the truth."""
        valid = self._valid[kind]
        poses, valid.waiting = valid.waiting, []
        stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
        positions = np.array([pose.position_m for pose in poses], dtype=np.float64).reshape(-1, 3)
        quaternions = np.array([pose.orientation_xyzw for pose in poses], dtype=np.float64).reshape(-1, 4)
        parameters = self._demo.parameters
        truth = self._demo.world.pose_at((stamps_ns - self._start_ns) / 1e9)
        errors = pose_errors(
            transform_from(rotation_from_quaternion(quaternions), positions),
            truth @ transform_of(parameters.reference_point),
            centroid_at_point(parameters),
        )
        valid.stamps_ns.extend(stamps_ns.tolist())
        valid.position_m.extend(errors.position_m.tolist())
        valid.centroid_m.extend(errors.centroid_m.tolist())
        valid.rotation_rad.extend(errors.rotation_rad.tolist())
        return valid

    def _pose(self, pose: PoseRecord) -> None:
        self.first_ns = self.first_ns or pose.stamp_ns
        self.last_ns = max(self.last_ns, pose.stamp_ns)
        self.poses[pose.kind] += 1
        if pose.valid:
            valid = self._valid[pose.kind]
            valid.newest = pose
            valid.waiting.append(pose)
            if len(valid.waiting) == _BATCH_POSES:
                self._compared(pose.kind)

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
        newest, errors = self._valid[self.kind].newest, self.errors(self.kind)
        text = f"{elapsed_s:5.0f} s  {len(errors.position_m)}/{self.poses[self.kind]} poses valid"
        if newest is not None:
            position = " ".join(f"{value:6.2f}" for value in newest.position_m or ())
            at = point_label(self._demo.parameters.reference_point)
            text += f"  {at} at {position} m  error {errors.position_rms_mm:.1f} mm rms"
        lines = [text]
        for station in status.stations:
            label, _ = station_label(station)
            rate = "" if station.rate_hz is None else f"  {station.rate_hz:.2f} Hz"
            strength = "" if station.rssi_dbm is None else f"  {station.rssi_dbm:.0f} dBm"
            bound_ns = station.stamp_bound_ns if station.clock_bound_ns is None else station.clock_bound_ns
            clock = "" if bound_ns is None else f"  clock bound {bound_ns / 1e6:.2f} ms"
            lines.append(f"         station {station.id}  {label}{rate}{strength}{clock}")
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
