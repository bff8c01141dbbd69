"""How a demonstration goes, on stderr: poses, what they are off the truth, and how each station does."""

from __future__ import annotations

import shutil
import sys
import time
from array import array
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import click
import numpy as np

from tsgt.analysis.metrics import PoseErrors, pose_errors
from tsgt.cli.status import station_word
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.master.stream_records import EventRecord, PoseRecord, StatusRecord
from tsgt.recording import decode

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.clock import UnixTimeline
    from tsgt.master.stream_records import Kind
    from tsgt.simulation.demo import Demo

LINE_INTERVAL_S = 5.0
"""How often there is a line where the output is no terminal."""


_COMPARED_AT_ONCE = 100
"""A day brings 3.5 million poses, so each is compared once, and only its stamp and its errors are kept."""


@dataclass(slots=True)
class _Valid:
    """Valid poses of one kind: the newest, those to be compared with the truth, and what the others have come to."""

    newest: PoseRecord | None = None
    waiting: list[PoseRecord] = field(default_factory=list)
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    position_m: array[float] = field(default_factory=lambda: array("d"))
    rotation_rad: array[float] = field(default_factory=lambda: array("d"))


class Progress:
    """Compares the poses of a demonstration with the truth and tells how it goes, with every status line of the master.

    Parameters
    ----------
    demo
        Truth and daemons.
    timeline
        From CLOCK_MONOTONIC, which the truth is on, to Unix time, which the poses are on.

    Attributes
    ----------
    poses
        How many have come, valid or not, by kind.
    first_ns, last_ns
        Unix time in ns of the first and the last of them; 0 before.
    """

    def __init__(self, demo: Demo, timeline: UnixTimeline) -> None:
        self._demo = demo
        self._start_ns = timeline.unix_ns(demo.start_ns)
        self._valid: defaultdict[Kind, _Valid] = defaultdict(_Valid)
        self._on_terminal = sys.stderr.isatty()
        self._block_lines = 0
        self._shown_at_s = 0.0
        self._starts = 0
        self.poses: Counter[Kind] = Counter()
        self.first_ns = 0
        self.last_ns = 0

    def line(self, line: bytes) -> None:
        """Take a line of the master's stream."""
        if line.startswith(b'{"type":"pose"'):
            self._pose(decode(PoseRecord, line))
        elif line.startswith(b'{"type":"status"'):
            self._status(decode(StatusRecord, line))
        elif line.startswith(b'{"type":"event"'):
            event = decode(EventRecord, line)
            self._say(f"event  {event.event}: {event.message}")

    @property
    def kind(self) -> Kind:
        """The kind of poses that the figures are of: the best that the estimator makes."""
        return "smoothed" if self.poses["predicted"] else "interpolated"

    def valid_stamps_ns(self, kind: Kind) -> NDArray[np.int64]:
        """Return the times of the valid poses of a kind, Unix time in ns."""
        return np.array(self._compared(kind).stamps_ns, dtype=np.int64)

    def errors(self, kind: Kind, counts: NDArray[np.bool_] | None = None) -> PoseErrors:
        """Tell how far valid poses of a kind are from the truth: all of them, or those that count."""
        compared = self._compared(kind)
        chosen = slice(None) if counts is None else counts
        return PoseErrors(np.array(compared.position_m)[chosen], np.array(compared.rotation_rad)[chosen])

    def _compared(self, kind: Kind) -> _Valid:
        """Compare the poses that wait for it."""
        valid = self._valid[kind]
        poses, valid.waiting = valid.waiting, []
        stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
        positions = np.array([pose.position_m for pose in poses], dtype=np.float64).reshape(-1, 3)
        quaternions = np.array([pose.orientation_xyzw for pose in poses], dtype=np.float64).reshape(-1, 4)
        world = self._demo.world
        errors = pose_errors(
            transform_from(rotation_from_quaternion(quaternions), positions),
            world.pose_at((stamps_ns - self._start_ns) / 1e9),
            world.prisms_m.mean(axis=0),
        )
        valid.stamps_ns.extend(stamps_ns.tolist())
        valid.position_m.extend(errors.position_m.tolist())
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
            if len(valid.waiting) == _COMPARED_AT_ONCE:
                self._compared(pose.kind)

    def _status(self, status: StatusRecord) -> None:
        starts = sum(process.starts for process in self._demo.processes)
        if starts != self._starts:
            self._starts = starts
            pids = "  ".join(f"{p.name}: {p.pid or 'down'}" for p in self._demo.processes)
            self._say(f"processes  {pids}")
        now_s = time.monotonic()
        if not self._on_terminal and now_s - self._shown_at_s < LINE_INTERVAL_S:
            return
        self._shown_at_s = now_s
        elapsed_s = (status.stamp_ns - self._start_ns) / 1e9
        newest, errors = self._valid[self.kind].newest, self.errors(self.kind)
        text = f"{elapsed_s:5.0f} s  {len(errors.position_m)}/{self.poses[self.kind]} poses valid"
        if newest is not None:
            position = " ".join(f"{value:6.2f}" for value in newest.position_m or ())
            text += f"  at {position} m  off {errors.position_rms_mm:.1f} mm rms"
        lines = [text]
        for station in status.stations:
            word, _ = station_word(station)
            rate = "" if station.rate_hz is None else f"  {station.rate_hz:.2f} Hz"
            strength = "" if station.rssi_dbm is None else f"  {station.rssi_dbm:.0f} dBm"
            bound_ns = station.stamp_bound_ns if station.clock_bound_ns is None else station.clock_bound_ns
            clock = "" if bound_ns is None else f"  clock within {bound_ns / 1e6:.2f} ms"
            lines.append(f"         station {station.id}  {word}{rate}{strength}{clock}")
        self._show(lines)

    def _show(self, lines: list[str]) -> None:
        """Write a block; on a terminal over the one before."""
        if self._on_terminal:
            up = f"\x1b[{self._block_lines}A" if self._block_lines else ""
            width = shutil.get_terminal_size().columns  # a line that wraps would not be written over
            click.echo(up + "\n".join(f"\x1b[K{line[:width]}" for line in lines), err=True)
            self._block_lines = len(lines)
        else:
            click.echo("\n".join(lines), err=True)

    def _say(self, text: str) -> None:
        """Write a line that stays."""
        self._block_lines = 0
        click.echo(text, err=True)
