"""Poses and positions in the CDR encoding of ROS 2 messages, in a fraction of the time that whole messages take.

The messages begin with stamp and names, then come numbers of fixed count: offsets follow from the lengths of the names. Alignment is
counted from the end of the encapsulation header (OMG DDSI-RTPS 2.3, section 10; OMG CDR).
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

_ENCAPSULATION = 4
_LITTLE_ENDIAN = b"\x00\x01"
_STAMP = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_DOUBLE = 8

POSE_NUMBERS = 7
"""x, y, z, then the quaternion x, y, z, w."""


class Layout(NamedTuple):
    """What a message begins with: its stamp, so many names, a NavSatStatus or not, and so many doubles."""

    names: int
    doubles: int
    has_status: bool = False


class Stamped(NamedTuple):
    """Stamp and names of a message or a part of one, and where its other fields begin."""

    stamp_ns: int
    names: tuple[str, ...]
    end: int


LAYOUTS = {
    "geometry_msgs/msg/PoseStamped": Layout(1, POSE_NUMBERS),
    "geometry_msgs/msg/TransformStamped": Layout(2, POSE_NUMBERS),
    "geometry_msgs/msg/PoseWithCovarianceStamped": Layout(1, POSE_NUMBERS + 36),
    "nav_msgs/msg/Odometry": Layout(2, POSE_NUMBERS + 36),
    "geometry_msgs/msg/PointStamped": Layout(1, 3),
    "sensor_msgs/msg/NavSatFix": Layout(1, 3 + 9, has_status=True),
}


def decode_messages(
    messages: Sequence[bytes], layout: Layout
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.int8]]:
    """Decode messages of one type.

    Returns stamps, (M,); the doubles, (M, K); the first byte after the names, (M,). Raises ValueError or struct.error for
    bytes that are no such message.
    """
    stamps, parts, flags = [], [], bytearray()
    size = _DOUBLE * layout.doubles
    for data in messages:
        check_encoding(data)
        stamp_ns, _, end = stamped_at(data, _ENCAPSULATION, layout.names)
        # A status is an int8 and a uint16 at an even offset.
        start = _aligned(_aligned(end + 1, 2) + 2 if layout.has_status else end, _DOUBLE)
        part = data[start : start + size]
        if len(part) != size:
            raise ValueError("a message ends too early")
        stamps.append(stamp_ns)
        parts.append(part)
        flags.append(data[end])
    numbers = np.frombuffer(b"".join(parts), dtype="<f8").reshape(-1, layout.doubles)
    return np.array(stamps, dtype=np.int64), numbers, np.frombuffer(flags, dtype=np.int8)


def decode_transforms(data: bytes) -> Iterator[tuple[int, tuple[str, ...], bytes]]:
    """Yield stamp, parent and child frame, and the seven doubles of each transform of a ``tf2_msgs/msg/TFMessage``."""
    check_encoding(data)
    yield from _sequence(data, _ENCAPSULATION, names=2)


def decode_path(data: bytes) -> Iterator[tuple[int, tuple[str, ...], bytes]]:
    """Yield stamp, frame and the seven doubles of each pose of a ``nav_msgs/msg/Path``."""
    check_encoding(data)
    yield from _sequence(data, stamped_at(data, _ENCAPSULATION, 1).end, names=1)


def stamped_at(data: bytes, start: int, names: int) -> Stamped:
    """Decode stamp and names from an offset."""
    at = _aligned(start, 4)
    seconds, nanoseconds = _STAMP.unpack_from(data, at)
    at += _STAMP.size
    found = []
    for _ in range(names):
        at = _aligned(at, 4)
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size + length
        if at > len(data):
            raise ValueError("a name ends behind the message")
        found.append(data[at - length : at].rstrip(b"\x00").decode(errors="replace"))
    return Stamped(seconds * 1_000_000_000 + nanoseconds, tuple(found), at)


def check_encoding(data: bytes) -> None:
    """Raise ValueError unless a message is in the little-endian CDR that all computers for ROS 2 write."""
    if data[:2] != _LITTLE_ENDIAN:
        raise ValueError(f"a message is encoded as {data[:2].hex()}; expected 0001, little-endian CDR")


def _sequence(data: bytes, start: int, *, names: int) -> Iterator[tuple[int, tuple[str, ...], bytes]]:
    at = _aligned(start, 4)
    (count,) = _LENGTH.unpack_from(data, at)
    at += _LENGTH.size
    for _ in range(count):
        stamp_ns, found, at = stamped_at(data, at, names)
        at = _aligned(at, _DOUBLE)
        end = at + _DOUBLE * POSE_NUMBERS
        if end > len(data):
            raise ValueError("a message ends too early")
        yield stamp_ns, found, data[at:end]
        at = end


def _aligned(at: int, size: int) -> int:
    return -(-(at - _ENCAPSULATION) // size) * size + _ENCAPSULATION
