"""Trajectories in bags of ROS 2: topics of poses, odometry, paths, transforms, positions and GNSS fixes."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.formats.bag import open_bag
from tsgt.analysis.formats.trajectories.cdr import (
    LAYOUTS,
    POSE_NUMBERS,
    decode_messages,
    decode_path,
    decode_transforms,
)
from tsgt.analysis.formats.trajectories.raw import MIN_POSES, RawTrajectory, usable_covariance
from tsgt.analysis.formats.trajectories.transform_tree import pose_in_tree
from tsgt.errors import InputFileError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from rosbags.highlevel import AnyReader

    from tsgt.geometry import FloatArray

NAVSAT = "sensor_msgs/msg/NavSatFix"
PATH = "nav_msgs/msg/Path"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
STATIC_SUFFIX = "_static"

_NO_FIX = 0  # Below: NavSatStatus.STATUS_NO_FIX
_MAX_LATITUDE = 90.0


def read_bag(path: Path, topics: Sequence[str]) -> list[tuple[str, str, RawTrajectory]]:
    """Read trajectories: topic, message type and poses of each.

    ``topics``: ``TOPIC``, or ``TOPIC:PARENT.CHILD`` of transforms; none: the only one that has poses. Raises InputFileError if a
    topic is missing or has no poses, or several could be meant; MissingExtraError without rosbags, or pymap3d for GNSS fixes.
    """
    if path.suffix == ".bag":
        raise InputFileError(
            "is a bag of ROS 1; convert it first: rosbags-convert --src FILE.bag --dst FOLDER", path=path
        )
    with open_bag(path) as reader:
        wanted = [_chosen(reader, topic, path) for topic in topics] or [_only(reader, path)]
        return [(topic, kind, _trajectory(reader, topic, kind, path)) for topic, kind in wanted]


def _chosen(reader: AnyReader, topic: str, path: Path) -> tuple[str, str]:
    kinds = {each.topic: each.msgtype for each in reader.connections}
    plain = topic.partition(":")[0]
    kind = kinds.get(topic) or kinds.get(plain)
    if kind is None:
        raise InputFileError(f"has no topic {plain}; {_listed(reader)}", path=path)
    if kind != TRANSFORMS and kind != PATH and kind not in LAYOUTS:
        raise InputFileError(f"has {kind} on {plain}, which holds no poses; {_listed(reader)}", path=path)
    if kind == TRANSFORMS and ":" not in topic:
        pairs = sorted(_transforms(reader, plain))
        if len(pairs) != 1:
            listed = ", ".join(f"{plain}:{parent}.{child}" for parent, child in pairs)
            raise InputFileError(
                f"has transforms of several frames on {plain}; give one of {listed}", path=path
            )
        topic = f"{plain}:{'.'.join(pairs[0])}"
    return topic, kind


def _only(reader: AnyReader, path: Path) -> tuple[str, str]:
    counts = _counts(reader)
    found = [
        each for each, count in counts.items() if each[1] != TRANSFORMS and (count > 1 or each[1] == PATH)
    ]
    if len(found) == 1:
        return found[0]
    transforms = [topic for topic, kind in counts if kind == TRANSFORMS and not topic.endswith(STATIC_SUFFIX)]
    if not found and transforms:
        return _chosen(reader, transforms[0], path)
    if not found:
        raise InputFileError(f"has no topic with poses; {_listed(reader)}", path=path)
    raise InputFileError(f"has several topics with poses; give --topic: {_listed(reader)}", path=path)


def _counts(reader: AnyReader) -> dict[tuple[str, str], int]:
    """Return the number of messages of each topic that may hold poses."""
    counts: dict[tuple[str, str], int] = defaultdict(int)
    for each in reader.connections:
        if each.msgtype in LAYOUTS or each.msgtype in (PATH, TRANSFORMS):
            counts[each.topic, each.msgtype] += each.msgcount
    return dict(sorted(counts.items()))


def _listed(reader: AnyReader) -> str:
    listed = ", ".join(
        f"{topic} ({kind.rpartition('/')[2]}, {count})" for (topic, kind), count in _counts(reader).items()
    )
    return f"there are {listed}" if listed else "it has no messages that hold poses"


def _trajectory(reader: AnyReader, topic: str, kind: str, path: Path) -> RawTrajectory:
    if kind == TRANSFORMS:
        return _transform(reader, topic, path)
    connections = [each for each in reader.connections if each.topic == topic and each.msgtype == kind]
    recorded, messages = [], []
    for _, recorded_ns, data in reader.messages(connections=connections):
        recorded.append(recorded_ns)
        messages.append(data)
    if not messages:
        raise InputFileError(f"has no messages on {topic}", path=path)
    if kind == PATH:
        return _path(messages, topic, path)
    stamp_ns, numbers, flags = decode_messages(messages, LAYOUTS[kind])
    notes: tuple[str, ...] = ()
    if not stamp_ns.any():
        stamp_ns = np.array(recorded, dtype=np.int64)
        notes = ("messages have no stamps: the times at which they were recorded are used",)
    if kind == NAVSAT:
        return _fixes(stamp_ns, numbers, flags >= _NO_FIX, notes)
    has_covariance = numbers.shape[1] > POSE_NUMBERS
    return RawTrajectory(
        stamp_ns=stamp_ns,
        position_m=numbers[:, :3],
        orientation_xyzw=numbers[:, 3:POSE_NUMBERS] if numbers.shape[1] >= POSE_NUMBERS else None,
        covariance=usable_covariance(numbers[:, POSE_NUMBERS:].reshape(-1, 6, 6)) if has_covariance else None,
        notes=notes,
    )


def _fixes(
    stamp_ns: NDArray[np.int64], numbers: FloatArray, fixed: NDArray[np.bool_], notes: tuple[str, ...]
) -> RawTrajectory:
    """Return positions in east, north, up about the first fix; covariances of ROS are along these axes."""
    try:
        from pymap3d import geodetic2enu  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise MissingExtraError("GNSS fixes", library="pymap3d", extra="gnss") from error
    fixed = fixed & np.isfinite(numbers[:, :3]).all(axis=1) & (np.abs(numbers[:, 0]) <= _MAX_LATITUDE)
    position_m = np.full((len(numbers), 3), np.nan)
    if fixed.any():
        origin = numbers[np.argmax(fixed), :3]
        position_m[fixed] = np.column_stack(geodetic2enu(*numbers[fixed, :3].T, *origin))
    covariance = np.zeros((len(numbers), 6, 6))
    covariance[:, :3, :3] = numbers[:, 3:].reshape(-1, 3, 3)
    return RawTrajectory(
        stamp_ns=stamp_ns,
        position_m=position_m,
        orientation_xyzw=None,
        covariance=usable_covariance(covariance),
        notes=(*notes, "latitude, longitude and height converted to east, north, up about the first fix"),
    )


def _path(messages: Sequence[bytes], topic: str, path: Path) -> RawTrajectory:
    """Return the poses of the last path, which programs publish anew with every pose."""
    raw = _joined((stamp_ns, numbers) for stamp_ns, _, numbers in decode_path(messages[-1]))
    if len(raw.stamp_ns) >= MIN_POSES and len(np.unique(raw.stamp_ns)) < MIN_POSES:
        raise InputFileError(f"has paths without times on {topic}: all poses have the same stamp", path=path)
    return raw.select(
        slice(None), *([f"the last of {len(messages)} paths was read"] if len(messages) > 1 else [])
    )


def _transform(reader: AnyReader, topic: str, path: Path) -> RawTrajectory:
    plain, _, frames = topic.partition(":")
    parent, separator, child = frames.partition(".")
    if not separator:
        raise InputFileError(f"{topic} names no transform; expected {plain}:PARENT.CHILD", path=path)
    static = _transforms(reader, f"{plain}{STATIC_SUFFIX}")
    return pose_in_tree(_transforms(reader, plain), static, parent, child, path)


def _transforms(reader: AnyReader, topic: str) -> dict[tuple[str, str], RawTrajectory]:
    """Return the transforms of a topic by parent and child frame."""
    connections = [each for each in reader.connections if each.topic == topic and each.msgtype == TRANSFORMS]
    found: dict[tuple[str, str], list[tuple[int, bytes]]] = defaultdict(list)
    if connections:
        for _, _, data in reader.messages(connections=connections):
            for stamp_ns, (parent, child), numbers in decode_transforms(data):
                found[parent.lstrip("/"), child.lstrip("/")].append((stamp_ns, numbers))
    return {pair: _joined(rows) for pair, rows in found.items()}


def _joined(rows: Iterable[tuple[int, bytes]]) -> RawTrajectory:
    stamps, parts = [], []
    for stamp_ns, part in rows:
        stamps.append(stamp_ns)
        parts.append(part)
    numbers = np.frombuffer(b"".join(parts), dtype="<f8").reshape(-1, POSE_NUMBERS)
    return RawTrajectory(
        stamp_ns=np.array(stamps, dtype=np.int64), position_m=numbers[:, :3], orientation_xyzw=numbers[:, 3:]
    )
