"""The ROS 2 messages that an export holds: their definitions, and their bytes.

ROS 2 writes messages as CDR (OMG DDSI-RTPS 2.3, section 10): here little-endian, each number at a multiple of its size
counted from after the first four bytes, texts with their length in front and a zero behind. All that is written here is
an instant, some texts, and numbers of eight bytes, so a general encoder, at ten times the time, is not needed.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import MessageError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

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
