"""What the rehearsal sees of the master: its stream, compared with the truth at the end."""

from __future__ import annotations

import asyncio
import bisect
import math
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, NoReturn

import numpy as np

from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.recording import MAX_LINE_BYTES, EventRecord, PoseRecord, StatusRecord, decode

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.clock import UnixTimeline
    from tsgt.simulation.rehearsal import Site

MAX_AGE_S = 4.0
"""Of a measurement; a busy computer delays some by a second or two."""

_RECONNECT_DELAY_S = 0.2


class Accuracy(NamedTuple):
    """Errors of the valid smoothed poses of a part of the day."""

    poses: int
    position_rms_mm: float
    position_max_mm: float
    orientation_rms_deg: float

    def text(self) -> str:
        """Return a line."""
        if not self.poses:
            return "no valid pose"
        return (
            f"{self.poses} valid poses, {self.position_rms_mm:.1f} mm rms (at most {self.position_max_mm:.1f} mm) at the "
            f"robot's origin, {self.orientation_rms_deg:.2f} deg rms"
        )


@dataclass(slots=True)
class Watch:
    """The stream of the master so far; connects again after each restart."""

    site: Site
    timeline: UnixTimeline
    socket: Path
    status: StatusRecord | None = None
    events: list[EventRecord] = field(default_factory=list)
    smoothed: list[PoseRecord] = field(default_factory=list)
    """Final smoothed poses that are valid."""
    connected: bool = False
    valid_s: list[float] = field(default_factory=list)
    """When valid live poses arrived, in s of the site."""

    async def run(self) -> NoReturn:
        """Read until cancelled."""
        while True:
            with suppress(OSError):
                reader, writer = await asyncio.open_unix_connection(self.socket, limit=MAX_LINE_BYTES)
                self.connected = True
                try:
                    while line := await reader.readline():
                        self._take(line)
                finally:
                    self.connected = False
                    writer.close()
            await asyncio.sleep(_RECONNECT_DELAY_S)

    def _take(self, line: bytes) -> None:
        if line.startswith(b'{"type":"pose"'):
            pose = decode(PoseRecord, line)
            if pose.kind == "smoothed" and pose.delay_s is None:
                self.smoothed += [pose] if pose.valid else []
            elif pose.kind == "predicted" and pose.valid:
                self.valid_s.append(self.site.now_s())
        elif line.startswith(b'{"type":"status"'):
            self.status = decode(StatusRecord, line)
        elif line.startswith(b'{"type":"event"'):
            self.events.append(decode(EventRecord, line))

    def site_s(self, unix_ns: int) -> float:
        """Return a stamp of the stream in s of the site."""
        return (unix_ns - self.timeline.unix_ns(self.site.start_ns)) / 1e9

    def event(self, names: set[str], after_s: float, station: int | None = None) -> EventRecord | None:
        """Return the first of these events since a time, of one station or of any."""
        return next(
            (
                each
                for each in self.events
                if each.event in names
                and self.site_s(each.stamp_ns) >= after_s
                and station in (None, each.station)
            ),
            None,
        )

    def measuring(self, station: int) -> bool:
        """Whether a station has measured its prism just now, by the last status of the master."""
        if not self.connected or self.status is None:
            return False
        found = next(each for each in self.status.stations if each.id == station)
        fresh = found.age_s is not None and found.age_s < MAX_AGE_S
        return fresh and found.status is not None and found.status.usable

    def valid_since(self, after_s: float) -> int:
        """Return the number of valid live poses since a time."""
        return len(self.valid_s) - bisect.bisect_left(self.valid_s, after_s)

    def accuracy(self, from_s: float, to_s: float = math.inf) -> Accuracy:
        """Compare the valid smoothed poses between two times with the truth."""
        poses = [each for each in self.smoothed if from_s <= self.site_s(each.stamp_ns) < to_s]
        if not poses:
            return Accuracy(0, math.nan, math.nan, math.nan)
        truth = self.site.world.pose_at(np.array([self.site_s(each.stamp_ns) for each in poses]))
        estimated = transform_from(
            rotation_from_quaternion(np.array([each.orientation_xyzw for each in poses], dtype=np.float64)),
            np.array([each.position_m for each in poses], dtype=np.float64),
        )
        off_mm = 1e3 * np.linalg.norm(estimated[:, :3, 3] - truth[:, :3, 3], axis=1)
        relative = np.einsum("nji,njk->nik", truth[:, :3, :3], estimated[:, :3, :3])
        cosine = np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)
        angle_deg = np.degrees(np.arccos(cosine))
        return Accuracy(
            len(poses),
            float(np.sqrt(np.mean(off_mm**2))),
            float(off_mm.max()),
            float(np.sqrt(np.mean(angle_deg**2))),
        )
