"""Our definitions and bytes against rosbags, which has ROS 2's own definitions and a decoder of its own."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tsgt.analysis.formats import mcap as ros2
from tsgt.errors import MessageError

TYPES = [ros2.POSE, ros2.POSE_WITH_COVARIANCE, ros2.ODOMETRY, ros2.POINT, ros2.TRANSFORMS]
HUMBLE = get_typestore(Stores.ROS2_HUMBLE)

numbers = st.floats(allow_nan=False)
names = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=9)
stamps = st.integers(0, 2**31 * 1_000_000_000 - 1)


def decoded(data: bytes, name: str) -> Any:
    """Decode with rosbags, which must not find a byte more or less than it expects."""
    message = HUMBLE.deserialize_cdr(data, name)
    # The decoder does not care for what is between the fields, the encoder writes zeros there, as we do.
    assert bytes(HUMBLE.serialize_cdr(message, name)) == data
    return message


def stamp_ns(header: Any) -> int:
    """Return the time of a header."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


@pytest.mark.parametrize("name", TYPES)
def test_definitions_are_those_of_ros_2(name: str) -> None:
    """A type's hash (RIHS01) is over the names, order and types of all fields in it."""
    ours = get_typestore(Stores.EMPTY)
    ours.register(get_types_from_msg(ros2.definition(name), name))
    assert ours.hash_rihs01(name) == HUMBLE.hash_rihs01(name)
    assert ours.generate_msgdef(name, ros_version=2) == HUMBLE.generate_msgdef(name, ros_version=2)


@given(stamps, names, st.tuples(numbers, numbers, numbers))
def test_a_point_comes_back(at: int, frame: str, point: tuple[float, float, float]) -> None:
    """Time, frame and numbers, to the last bit, wherever the frame's name ends."""
    message = decoded(ros2.stamped(at, (frame,), point), ros2.POINT)
    assert (stamp_ns(message.header), message.header.frame_id) == (at, frame)
    assert (message.point.x, message.point.y, message.point.z) == point


@given(stamps, names, names)
def test_odometry_comes_back(at: int, frame: str, child: str) -> None:
    """Each of its 85 numbers stands in its own field."""
    message = decoded(ros2.stamped(at, (frame, child), [float(k) for k in range(85)]), ros2.ODOMETRY)
    assert (stamp_ns(message.header), message.header.frame_id, message.child_frame_id) == (at, frame, child)
    pose, twist = message.pose.pose, message.twist.twist
    assert [pose.position.x, pose.orientation.x, pose.orientation.w] == [0.0, 3.0, 6.0]
    assert message.pose.covariance.tolist() == list(range(7, 43))
    assert [twist.linear.x, twist.angular.z] == [43.0, 48.0]
    assert message.twist.covariance.tolist() == list(range(49, 85))


@given(stamps, st.lists(st.tuples(names, names), max_size=4))
def test_transforms_come_back(at: int, frames: list[tuple[str, str]]) -> None:
    """Any number of them, with names of any length between the numbers."""
    entries = [
        ros2.Transform(frame, child, (k, 0.5, -1.0), (0.0, 0.6, 0.0, 0.8))
        for k, (frame, child) in enumerate(frames)
    ]
    message = decoded(ros2.transforms(at, entries), ros2.TRANSFORMS)
    assert [(t.header.frame_id, t.child_frame_id) for t in message.transforms] == frames
    assert [t.transform.translation.x for t in message.transforms] == list(range(len(frames)))
    assert {stamp_ns(t.header) for t in message.transforms} <= {at}
    assert {(t.transform.rotation.y, t.transform.rotation.w) for t in message.transforms} <= {(0.6, 0.8)}


def test_a_time_that_ros_2_cannot_tell_is_refused() -> None:
    """Its seconds have 32 bits with a sign; a wrapped time would be in 1901."""
    assert ros2.stamped(2**31 * 1_000_000_000 - 1, ("f",), ())
    with pytest.raises(MessageError, match="January 2038"):
        ros2.stamped(2**31 * 1_000_000_000, ("f",), ())
