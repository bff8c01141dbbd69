"""Poses and prism positions as an MCAP file with ROS 2 messages: for Foxglove, and what reads ROS 2 bags.

Topics and their contents are described in docs/reference/mcap.md.

The ROS 2 messages that an export holds: their definitions, and their bytes.

ROS 2 writes messages as CDR (OMG DDSI-RTPS 2.3, section 10): here little-endian, each number at a multiple of its size
counted from after the first four bytes, texts with their length in front and a zero behind. All that is written here is
an instant, some texts, and numbers of eight bytes, so a general encoder, at ten times the time, is not needed.
"""

from __future__ import annotations

import heapq
import struct
from functools import cache
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

import tsgt
from tsgt.errors import MessageError, MissingExtraError
from tsgt.estimation import build_tracks
from tsgt.geometry import quaternion_from_rotation
from tsgt.model import IDENTITY4, ROBOT_FRAME, WORLD_FRAME

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from tsgt.analysis.evaluation import Reference
    from tsgt.estimation import Track
    from tsgt.model import Parameters
    from tsgt.recording import PoseRecord, Recording

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
                text = definition(message.type)
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
        data = transforms(first.stamp_ns, fixed)
        yield Message(first.stamp_ns, FIXED_TRANSFORM_TOPIC, TRANSFORMS, data)
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
        yield Message(at, POSE_TOPIC, POSE_WITH_COVARIANCE, stamped(at, (frame,), where))
        turned = Transform(frame, child, position, orientation)
        yield Message(at, TRANSFORM_TOPIC, TRANSFORMS, transforms(at, [turned]))
        if pose.velocity_mps is not None and pose.angular_velocity_radps is not None:
            twist = (*_in_child_frame(pose.velocity_mps, orientation), *pose.angular_velocity_radps)
            numbers = (*where, *twist, *_UNKNOWN)
            yield Message(at, ODOMETRY_TOPIC, ODOMETRY, stamped(at, (frame, child), numbers))


def _of_track(prism: int, track: Track) -> Iterator[Message]:
    topic = prism_topic(prism)
    for at, point in zip(track.times_ns.tolist(), track.points_m.tolist(), strict=True):
        yield Message(at, topic, POINT, stamped(at, (WORLD_FRAME,), point))


def _of_reference(reference: Reference) -> Iterator[Message]:
    numbers = np.hstack([reference.position_m, reference.orientation_xyzw])
    for at, row in zip(reference.stamp_ns.tolist(), numbers.tolist(), strict=True):
        yield Message(at, REFERENCE_TOPIC, POSE, stamped(at, (WORLD_FRAME,), row))


def _fixed_transforms(parameters: Parameters) -> list[Transform]:
    """Where stations and prisms are; a station without a frame of its own (station 1, or points only) is left out."""
    found = []
    for station in parameters.stations:
        if station.T_station1_station != IDENTITY4:
            frame = np.array(station.T_station1_station)
            turned = quaternion_from_rotation(frame[:3, :3]).tolist()
            found.append(Transform(WORLD_FRAME, f"station{station.station}", frame[:3, 3].tolist(), turned))
    found.extend(
        Transform(ROBOT_FRAME, f"prism{prism.prism}", prism.position_m, _LEVEL) for prism in parameters.prisms
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


POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POINT = "geometry_msgs/msg/PointStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_VECTOR = ("float64 x", "float64 y", "float64 z")

# Names and order of the fields are ROS 2's; they have been the same in all its distributions.
_FIELDS: dict[str, tuple[str, ...]] = {
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "geometry_msgs/Point": _VECTOR,
    "geometry_msgs/Vector3": _VECTOR,
    "geometry_msgs/Quaternion": ("float64 x 0", "float64 y 0", "float64 z 0", "float64 w 1"),
    "geometry_msgs/Pose": ("geometry_msgs/Point position", "geometry_msgs/Quaternion orientation"),
    "geometry_msgs/PoseWithCovariance": ("geometry_msgs/Pose pose", "float64[36] covariance"),
    "geometry_msgs/Twist": ("geometry_msgs/Vector3 linear", "geometry_msgs/Vector3 angular"),
    "geometry_msgs/TwistWithCovariance": ("geometry_msgs/Twist twist", "float64[36] covariance"),
    "geometry_msgs/Transform": ("geometry_msgs/Vector3 translation", "geometry_msgs/Quaternion rotation"),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header",
        "string child_frame_id",
        "geometry_msgs/Transform transform",
    ),
    POSE: ("std_msgs/Header header", "geometry_msgs/Pose pose"),
    POSE_WITH_COVARIANCE: ("std_msgs/Header header", "geometry_msgs/PoseWithCovariance pose"),
    ODOMETRY: (
        "std_msgs/Header header",
        "string child_frame_id",
        "geometry_msgs/PoseWithCovariance pose",
        "geometry_msgs/TwistWithCovariance twist",
    ),
    POINT: ("std_msgs/Header header", "geometry_msgs/Point point"),
    TRANSFORMS: ("geometry_msgs/TransformStamped[] transforms",),
}

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_STAMP = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_LAST_SECOND = 2**31 - 1


class Transform(NamedTuple):
    """Where a frame lies in another.

    Attributes
    ----------
    frame, child_frame
        The pose is that of ``child_frame`` in ``frame``.
    position_m
        (3,).
    orientation_xyzw
        (4,), unit.
    """

    frame: str
    child_frame: str
    position_m: Sequence[float]
    orientation_xyzw: Sequence[float]


def definition(name: str) -> str:
    """Return a message's definition, followed by those of all types in it, as a bag holds it."""
    parts = ["\n".join(_FIELDS[name]) + "\n"]
    parts += [f"{'=' * 80}\nMSG: {part}\n" + "\n".join(_FIELDS[part]) + "\n" for part in _types_in(name)]
    return "".join(parts)


def stamped(stamp_ns: int, texts: tuple[str, ...], numbers: Iterable[float]) -> bytes:
    """Encode a message that is a header, perhaps a further frame's name, and 64-bit numbers.

    Parameters
    ----------
    stamp_ns
        Unix time in ns.
    texts
        Name of the frame, and of the child frame where the message has one.
    numbers
        The others of its fields, in their order.

    Raises
    ------
    MessageError
        The time is later than ROS 2 can tell: after January 2038.
    """
    values = tuple(numbers)
    head = _LITTLE_ENDIAN + _time(stamp_ns) + _texts(_STAMP.size, texts)
    return head + struct.pack(f"<{len(values)}d", *values)


def transforms(stamp_ns: int, entries: Sequence[Transform]) -> bytes:
    """Encode a message of :data:`TRANSFORMS`.

    Raises
    ------
    MessageError
        As for :func:`stamped`.
    """
    data = _LENGTH.pack(len(entries))
    for entry in entries:
        data += _time(stamp_ns)
        data += _texts(len(data), (entry.frame, entry.child_frame))
        data += struct.pack("<7d", *entry.position_m, *entry.orientation_xyzw)
    return _LITTLE_ENDIAN + data


def _types_in(name: str) -> list[str]:
    """Types of the fields, and of theirs, each once, in the order in which they are first met."""
    found: dict[str, None] = {}
    for field in _FIELDS[name]:
        part = field.split()[0].removesuffix("[]")
        if part in _FIELDS:
            found |= dict.fromkeys([part, *_types_in(part)])
    return list(found)


def _time(stamp_ns: int) -> bytes:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    if seconds > _LAST_SECOND:
        raise MessageError(
            f"a stamp of {seconds} s is after January 2038, where the times of ROS 2 end; "
            "was the clock wrong? Other formats can hold it"
        )
    return _STAMP.pack(seconds, nanoseconds)


@cache
def _texts(offset: int, texts: tuple[str, ...]) -> bytes:
    """Encode texts that begin at an offset, up to where a number of eight bytes may follow."""
    data = b""
    for text in texts:
        raw = text.encode() + b"\x00"
        data += bytes(-(offset + len(data)) % 4) + _LENGTH.pack(len(raw)) + raw
    return data + bytes(-(offset + len(data)) % 8)
