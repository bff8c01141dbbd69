"""Where to find what in a recording: an index by time, made in one pass over its lines."""

from __future__ import annotations

import bisect
import contextlib
import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, BinaryIO

from tsgt.errors import RecordingError
from tsgt.recording import MAX_LINE_BYTES, SETUP_START, EventRecord, decode, read_lines
from tsgt.recording.format import HEADER_START
from tsgt.web.mission.findings import kind

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_RECEIVED = re.compile(rb'"received_ns":(\d{1,19})')
_STAMP = re.compile(rb'"stamp_ns":(\d{1,19})')
PARAMETERS_START = b'{"type":"parameters",'
_EVENT_START = b'{"type":"event",'
_POSE_START = b'{"type":"pose",'
_PREDICTED = b'"kind":"predicted"'
_ARRIVED = (b'{"type":"measurement",', b'{"type":"point",', b'{"type":"imu",', b'{"type":"odometry",')
_MADE_AT_ONCE = (b'{"type":"status",', b'{"type":"beacon",', b'{"type":"clock",', SETUP_START, _EVENT_START)

INDEX_INTERVAL_S = 1.0
MAX_EVENTS = 20_000
BETWEEN_SESSIONS_S = 2.0


def instant_ns(line: bytes) -> int | None:
    """Return when the master passed a line on, on its Unix clock; None where the line does not tell.

    A smoothed or interpolated pose came with the line before it.
    """
    if line.startswith(_ARRIVED):
        found = _RECEIVED.search(line)
    elif line.startswith(_MADE_AT_ONCE) or (line.startswith(_POSE_START) and _PREDICTED in line):
        found = _STAMP.search(line)
    else:
        return None
    return int(found[1]) if found is not None else None


@dataclass(slots=True)
class Timeline:
    """Turns the instants of lines into the time of the replay, in s from its start; sessions follow one another."""

    at_s: float = 0.0
    unix_ns: int | None = None
    session_s: float = 0.0  # time of the replay at which the session began
    session_ns: int | None = None  # first instant of the session

    def advance(self, line: bytes) -> float:
        """Take the next line and return its time, which never runs backwards."""
        at_ns = instant_ns(line)
        if at_ns is not None:
            if self.session_ns is None:
                self.session_ns = at_ns
            self.unix_ns = at_ns
            self.at_s = max(self.at_s, self.session_s + (at_ns - self.session_ns) / 1e9)
        elif line.startswith(HEADER_START) and self.session_ns is not None:
            self.at_s += BETWEEN_SESSIONS_S
            self.session_s, self.session_ns = self.at_s, None
        return self.at_s


@dataclass(slots=True)
class RecordingIndex:
    """Index of a recording.

    ``lasting``: lines that hold until later ones: headers, set-ups and events, with their times. ``marks``: time and kind
    of each event, for the time bar.
    """

    path: Path
    lasting: list[tuple[float, bytes]] = field(default_factory=list)
    marks: list[tuple[float, str]] = field(default_factory=list)
    start_ns: int | None = None
    length_s: float = 0.0
    poses: int = 0
    places: list[tuple[Timeline, int]] = field(default_factory=list)
    """From where the replay can start: the timeline before the line at an offset in the file."""

    def read(self, file: BinaryIO) -> None:
        """Read all lines."""
        timeline, offset = Timeline(), 0
        while line := file.readline(MAX_LINE_BYTES):
            if not self.places or timeline.at_s >= self.places[-1][0].at_s + INDEX_INTERVAL_S:
                self.places.append((replace(timeline), offset))
            self._add(line, timeline.advance(line), timeline.unix_ns)
            offset += len(line)
        self.length_s = timeline.at_s

    def lines(self, from_s: float) -> Iterator[tuple[float, bytes]]:
        """Yield the lines of the file from a time on, each with its time."""
        after = bisect.bisect_right(self.places, from_s, key=lambda place: place[0].at_s)
        start, offset = self.places[max(0, after - 1)]
        timeline = replace(start)
        with self.path.open("rb") as file:
            file.seek(offset)
            while line := file.readline(MAX_LINE_BYTES):
                at_s = timeline.advance(line)
                if line.endswith(b"\n"):  # else it is torn, as the last one after a power cut
                    yield at_s, line

    def _add(self, line: bytes, at_s: float, unix_ns: int | None) -> None:
        if self.start_ns is None:
            self.start_ns = unix_ns
        if line.startswith(_POSE_START):
            self.poses += 1
        elif line.startswith((HEADER_START, SETUP_START, PARAMETERS_START)):
            self.lasting.append((at_s, line))
        elif line.startswith(_EVENT_START) and len(self.marks) < MAX_EVENTS:
            with contextlib.suppress(ValueError):  # torn
                self.marks.append((round(at_s, 1), kind(decode(EventRecord, line).event)))
                self.lasting.append((at_s, line))


def index_of(path: Path) -> RecordingIndex:
    """Read a recording once and return its index.

    Raises
    ------
    RecordingError
        It cannot be read, is no recording, or holds no poses.
    """
    next(read_lines(path))  # checks the header, with the message that a user needs
    index = RecordingIndex(path)
    try:
        with path.open("rb") as file:
            index.read(file)
    except (OSError, ValueError) as error:
        raise RecordingError(f"cannot be read ({error})", path=path) from error
    if not index.poses:
        raise RecordingError(
            "holds no poses to show; `tsgt replay` computes them from its measurements, for `tsgt web --socket`",
            path=path,
        )
    return index
