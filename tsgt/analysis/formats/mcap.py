"""Poses and prism positions as an MCAP file with ROS 2 messages, for Foxglove and readers of ROS 2 bags.

docs/reference/mcap.md describes topics and messages. Message types, their definitions and the CDR encoding are those of
ROS 2 Humble in rosbags; they have been the same in all distributions.
"""

from __future__ import annotations

import heapq
from functools import cache
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np

import tsgt
from tsgt.errors import MessageError, MissingExtraError
from tsgt.estimation import build_tracks, transform_between
from tsgt.geometry import quaternion_from_rotation
from tsgt.model import IDENTITY4, ROBOT_FRAME, ROBOT_ORIGIN, WORLD_FRAME

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rosbags.typesys.store import Typestore

    from tsgt.analysis.evaluation import Reference
    from tsgt.estimation import Track
    from tsgt.model import Parameters
    from tsgt.recording import PoseRecord, Recording

POSE_TOPIC = "/tsgt/pose"
ODOMETRY_TOPIC = "/tsgt/odometry"
REFERENCE_TOPIC = "/tsgt/reference"
TRANSFORM_TOPIC = "/tf"
STATIC_TRANSFORM_TOPIC = "/tf_static"

# Offered QoS of /tf_static: reliable and transient local, so that late subscribers receive it. The numeric values are
# those of bags of ROS 2 Humble, named in the metadata record rosbag2; later distributions read both notations.
_BAG_METADATA = {"ROS_DISTRO": "humble"}
_INFINITE = "{sec: 9223372036, nsec: 854775807}"
_STATIC_QOS = (
    "- {history: 1, depth: 1, reliability: 1, durability: 1, "
    f"deadline: {_INFINITE}, lifespan: {_INFINITE}, liveliness: 1, liveliness_lease_duration: {_INFINITE}, "
    "avoid_ros_namespace_conventions: false}"
)

_UNKNOWN_COVARIANCE = (0.0,) * 36
_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
_MAX_SECOND = 2**31 - 1


class Message(NamedTuple):
    """A message of the file: its time, topic and type, and its CDR encoding."""

    stamp_ns: int
    topic: str
    type: str
    data: bytes


def write_mcap(file: BinaryIO, messages: Iterable[Message]) -> None:
    """Write messages in the order given, at ``stamp_ns``. Raises MissingExtraError if mcap or rosbags is not installed."""
    try:
        from mcap.writer import Writer  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise MissingExtraError("MCAP files", library="mcap", extra="mcap") from error
    typestore = _typestore()
    writer = Writer(file)
    writer.start(profile="ros2", library=f"tsgt {tsgt.__version__}")
    writer.add_metadata("rosbag2", _BAG_METADATA)
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for message in messages:
        channel = channels.get(message.topic)
        if channel is None:
            if message.type not in schemas:
                definition, _ = typestore.generate_msgdef(message.type, ros_version=2)
                schemas[message.type] = writer.register_schema(message.type, "ros2msg", definition.encode())
            qos = {"offered_qos_profiles": _STATIC_QOS} if message.topic == STATIC_TRANSFORM_TOPIC else {}
            channel = writer.register_channel(message.topic, "cdr", schemas[message.type], qos)
            channels[message.topic] = channel
        writer.add_message(channel, message.stamp_ns, message.data, message.stamp_ns)
    writer.finish()  # type: ignore[no-untyped-call]  # not annotated in the library


def messages(
    recording: Recording, poses: Iterable[PoseRecord], reference: Reference | None = None
) -> Iterator[Message]:
    """Yield prism positions, valid ones of ``poses`` (in the order of time) and the reference, if any, in the order of time.

    ``poses`` are of the recording's reference point, to which the reference is carried over.
    Raises MessageError if a time is after January 2038, which ROS 2 cannot represent; MissingExtraError without rosbags.
    """
    tracks = build_tracks(recording.parameters, recording.measurements)
    sources = [_pose_messages(poses), *(_track_messages(prism, track) for prism, track in tracks.items())]
    if reference is not None:
        sources.append(_reference_messages(reference.of_point(recording.parameters.reference_point)))
    ordered = heapq.merge(*sources, key=lambda message: message.stamp_ns)
    first = next(ordered, None)
    if first is None:
        return
    transforms = _static_transforms(recording.parameters, first.stamp_ns)
    if transforms:
        yield _transforms(first.stamp_ns, STATIC_TRANSFORM_TOPIC, transforms)
    yield first
    yield from ordered


def prism_topic(prism: int) -> str:
    """Return the topic of a prism's positions."""
    return f"/tsgt/prism{prism}"


def _pose_messages(poses: Iterable[PoseRecord]) -> Iterator[Message]:
    for record in poses:
        position, orientation = record.position_m, record.orientation_xyzw
        if not record.valid or position is None or orientation is None:
            continue
        at, header = record.stamp_ns, _header(record.stamp_ns, record.frame)
        pose = _new(
            "geometry_msgs/msg/PoseWithCovariance",
            _pose(position, orientation),
            np.array(record.covariance or _UNKNOWN_COVARIANCE),
        )
        yield _encode(at, POSE_TOPIC, _new("geometry_msgs/msg/PoseWithCovarianceStamped", header, pose))
        transform = _transform(at, record.frame, record.child_frame, position, orientation)
        yield _transforms(at, TRANSFORM_TOPIC, [transform])
        if record.velocity_mps is not None and record.angular_velocity_radps is not None:
            twist = _new(
                "geometry_msgs/msg/Twist",
                _vector(_in_child_frame(record.velocity_mps, orientation)),
                _vector(record.angular_velocity_radps),
            )
            uncertain = _new("geometry_msgs/msg/TwistWithCovariance", twist, np.array(_UNKNOWN_COVARIANCE))
            odometry = _new("nav_msgs/msg/Odometry", header, record.child_frame, pose, uncertain)
            yield _encode(at, ODOMETRY_TOPIC, odometry)


def _track_messages(prism: int, track: Track) -> Iterator[Message]:
    topic = prism_topic(prism)
    for at, position in zip(track.times_ns.tolist(), track.points_m.tolist(), strict=True):
        point = _new("geometry_msgs/msg/Point", *position)
        yield _encode(at, topic, _new("geometry_msgs/msg/PointStamped", _header(at, WORLD_FRAME), point))


def _reference_messages(reference: Reference) -> Iterator[Message]:
    columns = reference.stamp_ns, reference.position_m, reference.orientation_xyzw
    for at, position, orientation in zip(*(column.tolist() for column in columns), strict=True):
        pose = _pose(position, orientation)
        yield _encode(
            at, REFERENCE_TOPIC, _new("geometry_msgs/msg/PoseStamped", _header(at, WORLD_FRAME), pose)
        )


def _static_transforms(parameters: Parameters, stamp_ns: int) -> list[Any]:
    """Return the frames of stations, robot and prisms; without stations whose frame is the world's (1, or imported points)."""
    transforms = []
    point = parameters.reference_point
    if point != ROBOT_ORIGIN:
        # A frame has one parent: the moving transform is that of the reference point, the robot frame hangs on it.
        T = transform_between(point, ROBOT_ORIGIN)
        orientation = quaternion_from_rotation(T[:3, :3]).tolist()
        transforms.append(_transform(stamp_ns, point.name, ROBOT_FRAME, T[:3, 3].tolist(), orientation))
    for station in parameters.stations:
        if station.T_station1_station != IDENTITY4:
            frame = np.array(station.T_station1_station)
            orientation = quaternion_from_rotation(frame[:3, :3]).tolist()
            name = f"station{station.station}"
            transforms.append(_transform(stamp_ns, WORLD_FRAME, name, frame[:3, 3].tolist(), orientation))
    transforms += [
        _transform(stamp_ns, ROBOT_FRAME, f"prism{prism.prism}", prism.position_m, _NO_ROTATION)
        for prism in parameters.prisms
    ]
    return transforms


def _in_child_frame(vector: Sequence[float], orientation_xyzw: Sequence[float]) -> tuple[float, float, float]:
    """Rotate a vector from the frame into the child frame: R^T v, by two cross products."""
    vx, vy, vz = vector
    x, y, z, w = orientation_xyzw
    tx, ty, tz = 2 * (z * vy - y * vz), 2 * (x * vz - z * vx), 2 * (y * vx - x * vy)
    return (
        vx + w * tx + z * ty - y * tz,
        vy + w * ty + x * tz - z * tx,
        vz + w * tz + y * tx - x * ty,
    )


@cache
def _typestore() -> Typestore:
    try:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise MissingExtraError("MCAP files", library="rosbags", extra="mcap") from error
    return get_typestore(Stores.ROS2_HUMBLE)


def _new(name: str, *fields: Any) -> Any:
    """Create a message from its fields in the order of the definition."""
    return _typestore().types[name](*fields)


def _encode(stamp_ns: int, topic: str, message: Any) -> Message:
    name: str = message.__msgtype__
    return Message(stamp_ns, topic, name, bytes(_typestore().serialize_cdr(message, name)))


def _header(stamp_ns: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    if seconds > _MAX_SECOND:
        raise MessageError(
            f"a timestamp of {seconds} s is after January 2038, which ROS 2 cannot represent; "
            "was the clock wrong? Other formats can hold it"
        )
    return _new("std_msgs/msg/Header", _new("builtin_interfaces/msg/Time", seconds, nanoseconds), frame)


def _vector(vector: Sequence[float]) -> Any:
    return _new("geometry_msgs/msg/Vector3", *vector)


def _quaternion(orientation_xyzw: Sequence[float]) -> Any:
    return _new("geometry_msgs/msg/Quaternion", *orientation_xyzw)


def _pose(position_m: Sequence[float], orientation_xyzw: Sequence[float]) -> Any:
    point = _new("geometry_msgs/msg/Point", *position_m)
    return _new("geometry_msgs/msg/Pose", point, _quaternion(orientation_xyzw))


def _transform(
    stamp_ns: int,
    frame: str,
    child_frame: str,
    position_m: Sequence[float],
    orientation_xyzw: Sequence[float],
) -> Any:
    transform = _new("geometry_msgs/msg/Transform", _vector(position_m), _quaternion(orientation_xyzw))
    return _new("geometry_msgs/msg/TransformStamped", _header(stamp_ns, frame), child_frame, transform)


def _transforms(stamp_ns: int, topic: str, transforms: list[Any]) -> Message:
    return _encode(stamp_ns, topic, _new("tf2_msgs/msg/TFMessage", transforms))
