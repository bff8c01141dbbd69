"""Files with poses as other programs write them: TUM, KITTI, EuRoC, CSV, bags of ROS 2."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tsgt.geometry import rotation_from_quaternion

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

START_NS = 1_700_000_000_123_456_789

STORE = get_typestore(Stores.ROS2_HUMBLE)


class Poses:
    """M random poses of a plausible path at 20 Hz, to the nanosecond."""

    def __init__(self, count: int = 50, seed: int = 1, start_ns: int = START_NS) -> None:
        rng = np.random.default_rng(seed)
        self.stamp_ns: NDArray[np.int64] = (
            start_ns + np.arange(count) * 50_000_000 + rng.integers(0, 1000, count)
        )
        self.position_m = np.cumsum(rng.normal(0.05, 0.02, (count, 3)), axis=0)
        quaternion = rng.standard_normal((count, 4))
        self.orientation_xyzw = quaternion / np.linalg.norm(quaternion, axis=1)[:, None]

    def rows(self) -> Iterable[tuple[int, list[float], list[float]]]:
        """Yield stamp, position and quaternion of each."""
        return zip(
            self.stamp_ns.tolist(), self.position_m.tolist(), self.orientation_xyzw.tolist(), strict=True
        )


def seconds(stamp_ns: int) -> str:
    """Write a time in s to the nanosecond."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def write_tum(path: Path, poses: Poses) -> Path:
    """As the TUM benchmark has it, to the last bit."""
    lines = [f"{seconds(t)} {' '.join(map(repr, (*p, *q)))}\n" for t, p, q in poses.rows()]
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(lines))
    return path


def write_euroc(path: Path, poses: Poses) -> Path:
    """Ground truth as in EuRoC's ``state_groundtruth_estimate0/data.csv``."""
    names = ["#timestamp", *(f" p_RS_R_{a} [m]" for a in "xyz"), *(f" q_RS_{a} []" for a in "wxyz")]
    names += [f" v_RS_R_{a} [m s^-1]" for a in "xyz"]
    names += [f" b_w_RS_S_{a} [rad s^-1]" for a in "xyz"] + [f" b_a_RS_S_{a} [m s^-2]" for a in "xyz"]
    lines = [
        ",".join([str(t), *map(repr, (*p, q[3], *q[:3])), *["0.0"] * 9]) + "\n" for t, p, q in poses.rows()
    ]
    path.write_text(",".join(names) + "\n" + "".join(lines))
    return path


def write_kitti(path: Path, poses: Poses, times: Path) -> Path:
    """Poses as 3x4 matrices, and times in s beside them."""
    rotation = rotation_from_quaternion(poses.orientation_xyzw)
    matrix = np.concatenate([rotation, poses.position_m[:, :, None]], axis=2).reshape(-1, 12)
    path.write_text("".join(" ".join(map(repr, row)) + "\n" for row in matrix.tolist()))
    times.write_text("".join(f"{seconds(t)}\n" for t in poses.stamp_ns.tolist()))
    return path


def write_bag(
    path: Path,
    topics: Mapping[str, Sequence[tuple[int, Any]]],
    *,
    plugin: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """Write messages by topic, each with the time at which it was recorded."""
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        for topic, messages in topics.items():
            kind = messages[0][1].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for recorded_ns, message in messages:
                writer.write(connection, recorded_ns, STORE.serialize_cdr(message, kind))
    return path


def new(kind: str, *fields: Any) -> Any:
    """Create a message from its fields in the order of the definition."""
    return STORE.types[kind](*fields)


def header(stamp_ns: int, frame: str = "map") -> Any:
    """Create a header."""
    stamp = new("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
    return new("std_msgs/msg/Header", stamp, frame)


def pose(position: Sequence[float], quaternion: Sequence[float]) -> Any:
    """Create a pose."""
    return new(
        "geometry_msgs/msg/Pose",
        new("geometry_msgs/msg/Point", *position),
        new("geometry_msgs/msg/Quaternion", *quaternion),
    )


def pose_stamped(stamp_ns: int, position: Sequence[float], quaternion: Sequence[float]) -> Any:
    """Create a pose with its time."""
    return new("geometry_msgs/msg/PoseStamped", header(stamp_ns), pose(position, quaternion))


def with_covariance(
    stamp_ns: int, position: Sequence[float], quaternion: Sequence[float], covariance: NDArray[np.float64]
) -> Any:
    """Create a pose with time and covariance, (6, 6)."""
    uncertain = new("geometry_msgs/msg/PoseWithCovariance", pose(position, quaternion), covariance.ravel())
    return new("geometry_msgs/msg/PoseWithCovarianceStamped", header(stamp_ns), uncertain)


def odometry(
    stamp_ns: int, position: Sequence[float], quaternion: Sequence[float], covariance: NDArray[np.float64]
) -> Any:
    """Create odometry at rest."""
    uncertain = new("geometry_msgs/msg/PoseWithCovariance", pose(position, quaternion), covariance.ravel())
    zero = new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    twist = new(
        "geometry_msgs/msg/TwistWithCovariance", new("geometry_msgs/msg/Twist", zero, zero), np.zeros(36)
    )
    return new("nav_msgs/msg/Odometry", header(stamp_ns, "odom"), "base_link", uncertain, twist)


def path_message(stamp_ns: int, poses: Sequence[Any]) -> Any:
    """Create a path."""
    return new("nav_msgs/msg/Path", header(stamp_ns), list(poses))


def point(stamp_ns: int, position: Sequence[float]) -> Any:
    """Create a position with its time."""
    return new("geometry_msgs/msg/PointStamped", header(stamp_ns), new("geometry_msgs/msg/Point", *position))


def fix(stamp_ns: int, latitude: float, longitude: float, height: float, *, status: int = 0) -> Any:
    """Create a GNSS fix with a covariance of 1, 4 and 9 cm^2."""
    covariance = np.diag([1e-4, 4e-4, 9e-4]).ravel()
    return new(
        "sensor_msgs/msg/NavSatFix",
        header(stamp_ns, "gps"),
        new("sensor_msgs/msg/NavSatStatus", status, 1),
        *(latitude, longitude, height, covariance, 2),
    )


def transforms(*edges: tuple[int, str, str, Sequence[float], Sequence[float]]) -> Any:
    """Create a message of transforms: time, parent, child, position and quaternion of each."""
    return new(
        "tf2_msgs/msg/TFMessage",
        [
            new(
                "geometry_msgs/msg/TransformStamped",
                header(stamp_ns, parent),
                child,
                new(
                    "geometry_msgs/msg/Transform",
                    new("geometry_msgs/msg/Vector3", *position),
                    new("geometry_msgs/msg/Quaternion", *quaternion),
                ),
            )
            for stamp_ns, parent, child, position, quaternion in edges
        ],
    )
