"""Poses and prism positions as an MCAP file with ROS 2 messages: for Foxglove, and what reads ROS 2 bags.

Topics and their contents are described in docs/reference/mcap.md.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

import tsgt
from tsgt.analysis import ros2_messages as ros2
from tsgt.errors import MissingExtraError
from tsgt.geometry import quaternion_from_rotation
from tsgt.master.tracks import build_tracks
from tsgt.model import IDENTITY4, ROBOT_FRAME, WORLD_FRAME

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from tsgt.analysis.reference import Reference
    from tsgt.master.stream_records import PoseRecord
    from tsgt.master.tracks import Track
    from tsgt.model import Parameters
    from tsgt.recording import Recording

POSE_TOPIC = "/tsgt/pose"
ODOMETRY_TOPIC = "/tsgt/odometry"
REFERENCE_TOPIC = "/tsgt/reference"
TRANSFORM_TOPIC = "/tf"
FIXED_TRANSFORM_TOPIC = "/tf_static"

# What a player offers for /tf_static: reliable, and transient local so that who comes later gets it too. The numbers
# are those of bags of ROS 2 Humble, which name their distribution in a record of the name rosbag2; later ones read
# both old and new bags, and tell them apart by that.
_BAG_METADATA = {"ROS_DISTRO": "humble"}
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
_FIXED_QOS = (
    "- {history: 1, depth: 1, reliability: 1, durability: 1, "
    f"deadline: {_FOREVER}, lifespan: {_FOREVER}, liveliness: 1, liveliness_lease_duration: {_FOREVER}, "
    "avoid_ros_namespace_conventions: false}"
)

_UNKNOWN = (0.0,) * 36
_LEVEL = (0.0, 0.0, 0.0, 1.0)


class Message(NamedTuple):
    """One message of the file."""

    stamp_ns: int
    topic: str
    type: str
    data: bytes


def write_mcap(file: BinaryIO, messages: Iterable[Message]) -> None:
    """Write messages in the order given; log time and publish time are the time that they are about.

    Raises
    ------
    MissingExtraError
        The library is not installed.
    """
    try:
        from mcap.writer import Writer  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise MissingExtraError("MCAP files", library="mcap", extra="mcap") from error
    writer = Writer(file)
    writer.start(profile="ros2", library=f"tsgt {tsgt.__version__}")
    writer.add_metadata("rosbag2", _BAG_METADATA)
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for message in messages:
        channel = channels.get(message.topic)
        if channel is None:
            if message.type not in schemas:
                text = ros2.definition(message.type)
                schemas[message.type] = writer.register_schema(message.type, "ros2msg", text.encode())
            qos = {"offered_qos_profiles": _FIXED_QOS} if message.topic == FIXED_TRANSFORM_TOPIC else {}
            channel = writer.register_channel(message.topic, "cdr", schemas[message.type], qos)
            channels[message.topic] = channel
        writer.add_message(channel, message.stamp_ns, message.data, message.stamp_ns)
    writer.finish()  # type: ignore[no-untyped-call]  # the library left this one out


def messages(
    recording: Recording, poses: Iterable[PoseRecord], reference: Reference | None = None
) -> Iterator[Message]:
    """Yield all messages in the order of time.

    Parameters
    ----------
    recording
        Measurements, from which the prisms' positions come, and the frames of stations and prisms.
    poses
        In the order of time; those that are not valid are passed over.
    reference
        A trajectory from elsewhere to look at beside them.

    Raises
    ------
    MessageError
        A time is later than ROS 2 can tell.
    """
    tracks = build_tracks(recording.parameters, recording.measurements)
    sources = [_of_poses(poses), *(_of_track(prism, track) for prism, track in tracks.items())]
    if reference is not None:
        sources.append(_of_reference(reference))
    ordered = heapq.merge(*sources, key=lambda message: message.stamp_ns)
    first = next(ordered, None)
    if first is None:
        return
    fixed = _fixed_transforms(recording.parameters)
    if fixed:
        data = ros2.transforms(first.stamp_ns, fixed)
        yield Message(first.stamp_ns, FIXED_TRANSFORM_TOPIC, ros2.TRANSFORMS, data)
    yield first
    yield from ordered


def prism_topic(prism: int) -> str:
    """Return the topic of a prism's positions."""
    return f"/tsgt/prism{prism}"


def _of_poses(poses: Iterable[PoseRecord]) -> Iterator[Message]:
    for pose in poses:
        position, orientation = pose.position_m, pose.orientation_xyzw
        if not pose.valid or position is None or orientation is None:
            continue
        at, frame, child = pose.stamp_ns, pose.frame, pose.child_frame
        where = (*position, *orientation, *(pose.covariance or _UNKNOWN))
        yield Message(at, POSE_TOPIC, ros2.POSE_WITH_COVARIANCE, ros2.stamped(at, (frame,), where))
        turned = ros2.Transform(frame, child, position, orientation)
        yield Message(at, TRANSFORM_TOPIC, ros2.TRANSFORMS, ros2.transforms(at, [turned]))
        if pose.velocity_mps is not None and pose.angular_velocity_radps is not None:
            twist = (*_in_child_frame(pose.velocity_mps, orientation), *pose.angular_velocity_radps)
            numbers = (*where, *twist, *_UNKNOWN)
            yield Message(at, ODOMETRY_TOPIC, ros2.ODOMETRY, ros2.stamped(at, (frame, child), numbers))


def _of_track(prism: int, track: Track) -> Iterator[Message]:
    topic = prism_topic(prism)
    for at, point in zip(track.times_ns.tolist(), track.points_m.tolist(), strict=True):
        yield Message(at, topic, ros2.POINT, ros2.stamped(at, (WORLD_FRAME,), point))


def _of_reference(reference: Reference) -> Iterator[Message]:
    numbers = np.hstack([reference.position_m, reference.orientation_xyzw])
    for at, row in zip(reference.stamp_ns.tolist(), numbers.tolist(), strict=True):
        yield Message(at, REFERENCE_TOPIC, ros2.POSE, ros2.stamped(at, (WORLD_FRAME,), row))


def _fixed_transforms(parameters: Parameters) -> list[ros2.Transform]:
    """Where stations and prisms are; a station without a frame of its own (station 1, or points only) is left out."""
    found = []
    for station in parameters.stations:
        if station.T_station1_station != IDENTITY4:
            frame = np.array(station.T_station1_station)
            turned = quaternion_from_rotation(frame[:3, :3]).tolist()
            found.append(
                ros2.Transform(WORLD_FRAME, f"station{station.station}", frame[:3, 3].tolist(), turned)
            )
    found.extend(
        ros2.Transform(ROBOT_FRAME, f"prism{prism.prism}", prism.position_m, _LEVEL)
        for prism in parameters.prisms
    )
    return found


def _in_child_frame(vector: Sequence[float], orientation_xyzw: Sequence[float]) -> tuple[float, float, float]:
    """Coordinates in the child frame of a vector given in the frame: R^T v, by two cross products."""
    vx, vy, vz = vector
    x, y, z, w = orientation_xyzw
    tx, ty, tz = 2 * (z * vy - y * vz), 2 * (x * vz - z * vx), 2 * (y * vx - x * vy)
    return (
        vx + w * tx + z * ty - y * tz,
        vy + w * ty + x * tz - z * tx,
        vz + w * tz + y * tx - x * ty,
    )
