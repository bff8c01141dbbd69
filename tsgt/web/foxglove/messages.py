"""Poses, frames and events as messages of Foxglove. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from foxglove.messages import (
    FrameTransform,
    FrameTransforms,
    Log,
    LogLevel,
    Pose,
    PoseInFrame,
    Quaternion,
    Timestamp,
    Vector3,
)

from tsgt.model import ROBOT_FRAME
from tsgt.web.frames import inverse, rotate
from tsgt.web.mission.findings import kind
from tsgt.web.mission.state import plain

if TYPE_CHECKING:
    from tsgt.model import Row4
    from tsgt.model import Vector3 as Position
    from tsgt.recording import EventRecord, PoseRecord, SetupRecord

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)

_LEVELS = {"alarm": LogLevel.Error, "note": LogLevel.Warning, "good": LogLevel.Info}


def timestamp(stamp_ns: int) -> Timestamp:
    """Return a time."""
    return Timestamp(*divmod(stamp_ns, 1_000_000_000))


def vector(position: Position) -> Vector3:
    """Return a vector."""
    x, y, z = position
    return Vector3(x=x, y=y, z=z)


def quaternion(orientation: Row4) -> Quaternion:
    """Return a rotation."""
    x, y, z, w = orientation
    return Quaternion(x=x, y=y, z=z, w=w)


def pose(position: Position, orientation: Row4) -> Pose:
    """Return a pose."""
    return Pose(position=vector(position), orientation=quaternion(orientation))


def pose_in_frame(record: PoseRecord, position: Position, orientation: Row4) -> bytes:
    """Return the message of a valid pose; the message has no place for validity."""
    return PoseInFrame(
        timestamp=timestamp(record.stamp_ns), frame_id=record.frame, pose=pose(position, orientation)
    ).encode()


def moving_frame(record: PoseRecord, position: Position, orientation: Row4) -> bytes:
    """Return the frame of a valid pose."""
    return FrameTransforms(
        transforms=[_frame(record.stamp_ns, record.frame, record.child_frame, position, orientation)]
    ).encode()


def fixed_frames(setup: SetupRecord, stamp_ns: int) -> bytes:
    """Return the frames of stations, robot and prisms, by the names of `tsgt export`."""
    frames = []
    point = setup.reference_point
    if setup.child_frame != ROBOT_FRAME:
        # A frame has one parent: the moving one is that of the reference point, the robot hangs on it.
        back = inverse(point.orientation_xyzw)
        x, y, z = rotate(back, point.position_m)
        frames.append(_frame(stamp_ns, setup.child_frame, ROBOT_FRAME, (-x, -y, -z), back))
    frames += [
        _frame(stamp_ns, setup.frame, f"station{each.id}", each.position_m, each.orientation_xyzw)
        for each in setup.stations
        if f"station{each.id}" != setup.frame
    ]
    frames += [
        _frame(stamp_ns, ROBOT_FRAME, f"prism{each.id}", each.position_m, NO_ROTATION)
        for each in setup.prisms
    ]
    return FrameTransforms(transforms=frames).encode()


def log_line(event: EventRecord) -> bytes:
    """Return an event."""
    return Log(
        timestamp=timestamp(event.stamp_ns),
        level=_LEVELS[kind(event.event)],
        message=plain(event.message),
        name=plain(event.event),
    ).encode()


def _frame(stamp_ns: int, parent: str, child: str, position: Position, orientation: Row4) -> FrameTransform:
    return FrameTransform(
        timestamp=timestamp(stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=vector(position),
        rotation=quaternion(orientation),
    )
