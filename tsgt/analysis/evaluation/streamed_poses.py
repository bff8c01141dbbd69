"""The poses of a recording as they were streamed live, with their age."""

from __future__ import annotations

import math
from array import array
from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import CorruptLineError
from tsgt.estimation import records_at
from tsgt.model import Parameters
from tsgt.recording import PoseRecord, decode_line, read_lines, replaced_line

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.model import ReferencePoint

_CHUNK = 1024


@dataclass(frozen=True, slots=True)
class _Arrival:
    """What lines that arrived at the master have in common."""

    received_ns: int


@dataclass(frozen=True, slots=True)
class StreamedPoses:
    """The poses of one series; arrays of the N valid ones, in the order of the stream."""

    poses: int  # valid or not
    stamp_ns: NDArray[np.int64]  # (N,)
    age_s: NDArray[np.float64]
    """(N,) of predicted poses: age of the newest measurement of any prism at the stamp; of others: age of the pose when it
    was sent, known to one period of the poses. NaN where unknown."""
    position_m: NDArray[np.float64]  # (N, 3) of the point in frame ``station1``
    orientation_xyzw: NDArray[np.float64]  # (N, 4)
    covariance: NDArray[np.float64]  # (N, 6, 6)


def newest_age_s(pose: PoseRecord) -> float:
    """Return the age of the newest measurement of any prism at the stamp of a pose, in s; NaN without any."""
    return min((share.age_s for share in pose.stations if share.age_s is not None), default=math.nan)


def read_streamed_poses(
    path: Path, point: ReferencePoint, *, keep_going: bool = False
) -> dict[str, StreamedPoses]:
    """Read the poses of a recording by series, as those of a point of the robot; empty without poses.

    Those before a set-up that was replaced while the master ran are left out, as their measurements are. ``keep_going``: skip lines
    that cannot be read instead of raising CorruptLineError; what :func:`~tsgt.recording.read_lines` raises.
    """
    reader, first_line = _Reader(point), replaced_line(path)
    for line in read_lines(path, keep_going=keep_going):
        try:
            match line.type:
                case "parameters":
                    reader.start_session(decode_line(Parameters, line, path).reference_point)
                case "measurement" | "point":
                    reader.now(decode_line(_Arrival, line, path).received_ns)
                case "pose" if line.number >= first_line:
                    reader.pose(decode_line(PoseRecord, line, path))
        except CorruptLineError:
            if not keep_going:
                raise
    return reader.finish()


class _Reader:
    def __init__(self, point: ReferencePoint) -> None:
        self._point = self._recorded_point = point
        self._now_ns = 0
        self._counts: Counter[str] = Counter()
        self._waiting: list[tuple[PoseRecord, float]] = []
        # Sent with the next predicted pose, whose stamp is the instant.
        self._unsent: list[PoseRecord] = []
        self._stamps: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))
        self._numbers: defaultdict[str, array[float]] = defaultdict(lambda: array("d"))

    def start_session(self, point: ReferencePoint) -> None:
        self._send_all()
        self._store()
        self._recorded_point = point
        self._now_ns = 0

    def now(self, now_ns: int) -> None:
        self._now_ns = max(self._now_ns, now_ns)

    def pose(self, pose: PoseRecord) -> None:
        self._counts[pose.series] += 1
        if pose.kind == "predicted":
            self.now(pose.stamp_ns)
            self._send_all()
        if pose.valid:
            if pose.kind == "predicted":
                self._waiting.append((pose, newest_age_s(pose)))
            elif pose.kind == "smoothed":
                self._unsent.append(pose)
            else:  # sent with the measurement that completed it
                self._waiting.append((pose, (self._now_ns - pose.stamp_ns) / 1e9))
        if len(self._waiting) >= _CHUNK:
            self._store()

    def finish(self) -> dict[str, StreamedPoses]:
        self._send_all()
        self._store()
        found = {}
        for series, count in sorted(self._counts.items()):
            numbers = np.array(self._numbers[series]).reshape(-1, 44)
            found[series] = StreamedPoses(
                poses=count,
                stamp_ns=np.array(self._stamps[series], dtype=np.int64),
                age_s=numbers[:, 0],
                position_m=numbers[:, 1:4],
                orientation_xyzw=numbers[:, 4:8],
                covariance=numbers[:, 8:].reshape(-1, 6, 6),
            )
        return found

    def _send_all(self) -> None:
        self._waiting += [(pose, (self._now_ns - pose.stamp_ns) / 1e9) for pose in self._unsent]
        self._unsent.clear()

    def _store(self) -> None:
        poses: Iterator[PoseRecord] = iter([pose for pose, _ in self._waiting])
        if self._recorded_point != self._point:
            poses = records_at(poses, self._recorded_point, self._point)
        for pose, (_, age_s) in zip(poses, self._waiting, strict=True):
            if pose.position_m is None or pose.orientation_xyzw is None or pose.covariance is None:
                continue  # no program of ours writes such a valid pose
            self._stamps[pose.series].append(pose.stamp_ns)
            self._numbers[pose.series].extend(
                (age_s, *pose.position_m, *pose.orientation_xyzw, *pose.covariance)
            )
        self._waiting.clear()
