"""``tsgt status --watch``: what the lines so far say about the mission now. Sans-I/O.

What is shown as present must be present: every judgement rests on when lines arrived here, never on a stamp, so that a
stream that has stopped is not shown as good.
"""

from __future__ import annotations

import textwrap
from collections import deque
from typing import TYPE_CHECKING

import click

from tsgt.cli.live.pose_text import pose_block
from tsgt.cli.live.status_text import NO_KEY, client_text, duration, master_blocks
from tsgt.cli.output import printable
from tsgt.cli.render import clock_time
from tsgt.recording import EventRecord, PoseRecord, StatusRecord, Typed, decode
from tsgt.station import ClientStatus
from tsgt.web.mission import MissionState
from tsgt.web.mission.verdict import POSE_AGE_LIMIT_S, Level

if TYPE_CHECKING:
    from tsgt.cli.live.status_text import Block

MAX_SILENCE_S = 3.0
"""A client sends its status each second; without one for this long it has stopped."""

MAX_EVENTS = 100

MAX_CAUSE_LINES = 3

_COLOURS = {"GOOD": "green", "CARE": "yellow"}


class Watch:
    """Collects lines of a stream; instants are on the monotonic clock of this computer in s.

    The verdict on a master is that of the operator's page.
    """

    def __init__(self) -> None:
        self._mission = MissionState("stream")
        self.events: deque[str] = deque(maxlen=MAX_EVENTS)
        self._line_s: float | None = None
        self._status: StatusRecord | ClientStatus | None = None
        self._pose: PoseRecord | None = None
        self._pose_s = 0.0

    def take(self, line: bytes, now_s: float) -> None:
        """Take a line; raises ValueError if it cannot be read."""
        match decode(Typed, line).type:
            case "hello":  # another process, or another replay
                self._status = self._pose = None
                self._mission.connected(now_s)
            case "status":
                self._status = decode(StatusRecord, line)
            case "client_status":
                self._status = decode(ClientStatus, line)
            case "pose":
                pose = decode(PoseRecord, line)
                if pose.kind != "smoothed":
                    self._pose, self._pose_s = pose, now_s
            case "event":
                self.events.append(event_text(decode(EventRecord, line)))
        self._line_s = now_s
        if not isinstance(self._status, ClientStatus):
            self._mission.line(line, now_s)

    def verdict(self, now_s: float, problem: str) -> tuple[str, str]:
        """Return the verdict and its cause; ``problem``: why there is no connection, empty while there is one."""
        silence_s = None if self._line_s is None else now_s - self._line_s
        # A client sends its status and disconnects.
        if problem and not (isinstance(self._status, ClientStatus) and (silence_s or 0.0) < MAX_SILENCE_S):
            return "NO CONNECTION", problem
        if silence_s is None:
            return "NO CONNECTION", "nothing has been received yet"
        if isinstance(self._status, ClientStatus):
            if silence_s > MAX_SILENCE_S:
                return "STREAM STOPPED", f"nothing received for {duration(silence_s)}"
            lines, ok = client_text(self._status)
            return ("GOOD", "") if ok else ("CARE", click.unstyle(lines[0]))
        verdict, *others = self._mission.findings_now(now_s)
        if verdict.level is Level.GOOD:
            return verdict.level.words, ""
        causes = [verdict.cause, *(each.cause for each in others if each.level == verdict.level)]
        return verdict.level.words, "; ".join(causes)

    def view(self, now_s: float, problem: str, *, width: int) -> tuple[list[str], list[Block]]:
        """Return headlines and blocks of the screen."""
        verdict, cause = self.verdict(now_s, problem)
        time = "" if self._status is None else clock_time(self._status.stamp_ns)[:8]
        title = f" {verdict}".ljust(max(width - len(time) - 1, 0)) + time
        headlines = [
            click.style(title[:width].ljust(width), bold=True, reverse=True, fg=_COLOURS.get(verdict, "red")),
            *textwrap.wrap(printable(cause), max(width, 10))[:MAX_CAUSE_LINES],
        ]
        return headlines, self._blocks(now_s, fresh=verdict in ("GOOD", "CARE", "NO POSE"))

    def _blocks(self, now_s: float, *, fresh: bool) -> list[Block]:
        """Return what was received; of a stream that has stopped nothing, because it would look like the present."""
        if not fresh or self._status is None:
            return []
        if isinstance(self._status, ClientStatus):
            return [client_text(self._status)[0]]
        blocks, _ = master_blocks(self._status)
        poses = [f"poses {self._status.poses}, valid {self._status.valid_poses}"]
        if self._pose is not None and now_s - self._pose_s <= POSE_AGE_LIMIT_S:
            poses = [*pose_block(self._pose), f"  {poses[0]}"]
        if self._status.protocol == "superframe" and not self._status.authenticated:
            poses.append(f"  {NO_KEY}")
        return [poses, *blocks]


def event_text(event: EventRecord) -> str:
    """Return an event as one line."""
    return f"{clock_time(event.stamp_ns)[:8]} {event.event}: {event.message}"
