"""Which messages follow from the stream: with each line, and with each view of the page. Sans-I/O.

Times of messages are those of the master's clock. Only a valid pose of a live stream becomes a pose, a frame and a robot in the scene; the
channel of the mission says five times a second whether the pose is valid now, and why it is not.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, NamedTuple

from tsgt.recording import EventRecord, PoseRecord, StatusRecord, decode
from tsgt.web.foxglove import channels, messages, scene

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tsgt.model import Vector3
    from tsgt.web.mission import MissionState

TRAIL_INTERVAL_S = 1.0

_POSE, _STATUS, _EVENT = b'{"type":"pose"', b'{"type":"status"', b'{"type":"event"'
_SETUP = b'{"type":"setup"'
_SMOOTHED = b'"kind":"smoothed"'


class Message(NamedTuple):
    """A message on a channel."""

    topic: str
    stamp_ns: int
    data: bytes


class Feed:
    """Makes the messages.

    Parameters
    ----------
    state
        What is known of the mission; it gets each line first.
    wanted
        Whether any app has subscribed to a topic; nothing is made for others.
    """

    def __init__(self, state: MissionState, wanted: Callable[[str], bool]) -> None:
        self._state = state
        self._wanted = wanted
        self._forget()

    def _forget(self) -> None:
        self._stamp_ns: int | None = None
        self._stamp_s = 0.0
        self._last: Vector3 | None = None
        self._frames: Any = None
        self._trail_s = -math.inf

    def now_ns(self, now_s: float) -> int | None:
        """Return the time on the master's clock; None before its first status."""
        return None if self._stamp_ns is None else self._stamp_ns + round(1e9 * (now_s - self._stamp_s))

    def connected(self) -> None:
        """Take note of a new connection to the stream: perhaps another master, with another clock."""
        self._forget()

    def line(self, data: bytes, now_s: float) -> Iterator[Message]:
        """Return the messages of a line that the state has taken."""
        if data.startswith(_POSE) and _SMOOTHED not in data:
            if any(map(self._wanted, (channels.POSE, channels.TRANSFORMS, channels.SCENE))):
                yield from self._pose(decode(PoseRecord, data), now_s)
        elif data.startswith(_STATUS):
            self._stamp_ns, self._stamp_s = decode(StatusRecord, data).stamp_ns, now_s
            yield Message(channels.STATUS, self._stamp_ns, data.strip())
        elif data.startswith(_SETUP) and self._state.frames != self._frames:
            self._frames, self._last = self._state.frames, None
        elif data.startswith(_EVENT) and self._wanted(channels.EVENTS):
            event = decode(EventRecord, data)
            yield Message(channels.EVENTS, self.now_ns(now_s) or event.stamp_ns, messages.log_line(event))

    def view(self, view: dict[str, Any], now_s: float) -> Iterator[Message]:
        """Return the messages of a view of the page."""
        stamp_ns = self.now_ns(now_s)
        if stamp_ns is None:
            return
        pose = view["pose"]
        valid = pose is not None and pose["valid"]
        if self._wanted(channels.MISSION):
            mission = {
                **view,
                "pose_valid": valid,
                "pose_age_s": None if pose is None else pose["age_s"],
            }
            yield Message(channels.MISSION, stamp_ns, json.dumps(mission, allow_nan=False).encode())
        setup = self._state.setup
        if setup is None:
            return
        if self._wanted(channels.SCENE):
            if not valid:
                yield Message(channels.SCENE, stamp_ns, scene.no_robot(setup.frame, self._last, stamp_ns))
            around = scene.surroundings(
                setup.frame,
                setup.stations,
                {each["id"]: each["state"] for each in view["stations"]},
                self._state.sight_points(now_s),
                setup.geofences,
                0.0 if self._last is None else self._last[2],
                stamp_ns,
            )
            yield Message(channels.SCENE, stamp_ns, around)
        if now_s - self._trail_s < TRAIL_INTERVAL_S:
            return
        self._trail_s = now_s
        if self._wanted(channels.SCENE):
            points = self._state.trail.since(0)["items"]
            yield Message(channels.SCENE, stamp_ns, scene.trail(setup.frame, points, stamp_ns))
        if self._wanted(channels.TRANSFORMS):
            # Again and again, for those who have just connected.
            yield Message(channels.TRANSFORMS, stamp_ns, messages.fixed_frames(setup, stamp_ns))

    def _pose(self, record: PoseRecord, now_s: float) -> Iterator[Message]:
        stamp_ns = self.now_ns(now_s) or record.stamp_ns
        position, orientation = record.position_m, record.orientation_xyzw
        live = self._state.live(now_s)  # else the pose is one of before, however valid
        if not (live and record.valid) or position is None or orientation is None:
            yield Message(channels.SCENE, stamp_ns, scene.no_robot(record.frame, self._last, stamp_ns))
            return
        self._last, rotation = self._state.robot(position, orientation)
        setup = self._state.setup
        prisms = setup.prisms if setup is not None else ()
        yield Message(channels.POSE, stamp_ns, messages.pose_in_frame(record, position, orientation))
        yield Message(channels.TRANSFORMS, stamp_ns, messages.moving_frame(record, position, orientation))
        yield Message(
            channels.SCENE,
            stamp_ns,
            scene.robot(
                record.frame, self._last, rotation, prisms, stamp_ns, good=record.quality in {None, "good"}
            ),
        )
