"""Estimates from bags of ROS 2, written by rosbags: every type bit for bit, choice of topics, transforms along the tree."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.pose_files import (
    Poses,
    fix,
    odometry,
    path_message,
    point,
    pose_stamped,
    transforms,
    with_covariance,
    write_bag,
)
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from tsgt.analysis.formats.trajectories import read_estimates
from tsgt.analysis.formats.trajectories.cdr import LAYOUTS, decode_messages
from tsgt.errors import InputFileError, MissingExtraError
from tsgt.geometry import rotation_from_quaternion, transform_from

if TYPE_CHECKING:
    from pathlib import Path

POSES = Poses(20)
TYPES = get_typestore(Stores.ROS2_HUMBLE)
COVARIANCE = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]) + 0.01
LATE_NS = 7_000_000  # from stamp to recording


def messages(kind: str) -> list[tuple[int, Any]]:
    """Write all poses as messages of one type."""
    made: Any = {
        "pose": pose_stamped,
        "covariance": lambda t, p, q: with_covariance(t, p, q, COVARIANCE),
        "odometry": lambda t, p, q: odometry(t, p, q, COVARIANCE),
        "point": lambda t, p, _: point(t, p),
        "tf": lambda t, p, q: transforms((t, "odom", "base", p, q), (t, "odom", "camera", p[::-1], q)),
    }[kind]
    return [(t + LATE_NS, made(t, p, q)) for t, p, q in POSES.rows()]


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_topics_of_poses_round_trip(tmp_path: Path, plugin: StoragePlugin) -> None:
    """SQLite and MCAP, folder and single file: stamps of the messages, poses and covariances to the last bit."""
    kinds = ("pose", "covariance", "odometry", "point")
    bag = write_bag(tmp_path / "run", {f"/{kind}": messages(kind) for kind in kinds}, plugin=plugin)
    single = next(each for each in bag.iterdir() if each.suffix in (".mcap", ".db3"))
    for path in (bag, single):
        found = read_estimates(path, topics=[f"/{kind}" for kind in kinds])
        assert [each.name for each in found] == [f"run /{kind}" for kind in kinds]
        for kind, each in zip(kinds, found, strict=True):
            np.testing.assert_array_equal(each.stamp_ns, POSES.stamp_ns)
            np.testing.assert_array_equal(each.position_m, POSES.position_m)
            if kind == "point":
                assert each.orientation_xyzw is None
            else:
                assert each.orientation_xyzw is not None
                np.testing.assert_allclose(each.orientation_xyzw, POSES.orientation_xyzw, rtol=0, atol=1e-15)
            if kind in ("covariance", "odometry"):
                assert each.covariance is not None
                np.testing.assert_array_equal(each.covariance, [COVARIANCE] * 20)
            else:
                assert each.covariance is None


@pytest.mark.parametrize("frame", ["", "g", "gps", "base", "gps_link", "navsat_link"])
def test_fix_is_decoded_whatever_the_length_of_its_frame(frame: str) -> None:
    """The numbers are aligned to eight bytes behind the names, against the message that rosbags decodes."""
    message = fix(5_000_000_006, 46.5, -71.2, 100.0, status=2)
    message.header.frame_id = frame
    data = bytes(TYPES.serialize_cdr(message, "sensor_msgs/msg/NavSatFix"))
    stamps, numbers, flags = decode_messages([data], LAYOUTS["sensor_msgs/msg/NavSatFix"])
    assert (stamps.tolist(), flags.tolist()) == ([5_000_000_006], [2])
    np.testing.assert_array_equal(numbers, [[46.5, -71.2, 100.0, *message.position_covariance]])


def test_only_topic_is_found(tmp_path: Path) -> None:
    """Its name is that of the bag."""
    (found,) = read_estimates(write_bag(tmp_path / "run", {"/slam/odometry": messages("odometry")}))
    assert found.name == "run"
    assert found.source.endswith("run, /slam/odometry, nav_msgs/msg/Odometry")


def test_several_topics_are_listed(tmp_path: Path) -> None:
    """Type and number of messages of each."""
    bag = write_bag(
        tmp_path / "run", {"/a": messages("pose"), "/b": messages("odometry"), "/tf": messages("tf")}
    )
    with pytest.raises(InputFileError) as refused:
        read_estimates(bag)
    assert "give --topic: there are /a (PoseStamped, 20), /b (Odometry, 20), /tf (TFMessage, 20)" in str(
        refused.value
    )
    with pytest.raises(InputFileError, match="has no topic /c; there are /a"):
        read_estimates(bag, topics=["/c"])


@pytest.mark.parametrize("entry", [0.0, -1.0, np.nan])
def test_unknown_covariance(tmp_path: Path, entry: float) -> None:
    """All zero, -1 in the first entry, or no number."""
    covariance = np.zeros((6, 6))
    covariance[0, 0] = entry
    rows = [(t, odometry(t, p, q, covariance)) for t, p, q in POSES.rows()]
    (found,) = read_estimates(write_bag(tmp_path / "run", {"/odom": rows}))
    assert found.covariance is None


def test_last_path_is_read(tmp_path: Path) -> None:
    """Programs publish the whole path anew with every pose."""
    stamped = [pose_stamped(t, p, q) for t, p, q in POSES.rows()]
    rows = [(t, path_message(t, stamped[: n + 1])) for n, t in enumerate(POSES.stamp_ns.tolist())]
    (found,) = read_estimates(write_bag(tmp_path / "run", {"/path": rows}))
    np.testing.assert_array_equal(found.stamp_ns, POSES.stamp_ns)
    np.testing.assert_array_equal(found.position_m, POSES.position_m)
    assert found.notes == ("the last of 20 paths was read",)


def test_path_without_times_is_refused(tmp_path: Path) -> None:
    """Some programs leave the stamps of its poses zero."""
    path = path_message(1, [pose_stamped(0, p, q) for _, p, q in POSES.rows()])
    with pytest.raises(InputFileError, match="all poses have the same stamp"):
        read_estimates(write_bag(tmp_path / "run", {"/path": [(1, path)]}))


def test_messages_without_stamps_have_the_time_of_recording(tmp_path: Path) -> None:
    """And a note says so."""
    rows = [(t, pose_stamped(0, p, q)) for t, p, q in POSES.rows()]
    (found,) = read_estimates(write_bag(tmp_path / "run", {"/pose": rows}))
    np.testing.assert_array_equal(found.stamp_ns, POSES.stamp_ns)
    assert found.notes == ("messages have no stamps: the times at which they were recorded are used",)


def test_transform_between_two_frames(tmp_path: Path) -> None:
    """The pair is chosen; without, the pairs are listed."""
    bag = write_bag(tmp_path / "run", {"/tf": messages("tf")})
    (found,) = read_estimates(bag, topics=["/tf:odom.base"])
    np.testing.assert_array_equal(found.stamp_ns, POSES.stamp_ns)
    np.testing.assert_array_equal(found.position_m, POSES.position_m)
    with pytest.raises(InputFileError, match=r"give one of /tf:odom\.base, /tf:odom\.camera"):
        read_estimates(bag)
    with pytest.raises(InputFileError, match=r"no transforms between map and base; there are odom\.base"):
        read_estimates(bag, topics=["/tf:map.base"])


def test_transform_along_the_tree(tmp_path: Path) -> None:
    """Map -> odom at a lower rate, odom -> base, and a static base -> lidar, against the product of matrices."""
    quarter = [0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)]
    stamps = POSES.stamp_ns.tolist()
    slow = [
        (t, transforms((t, "map", "odom", [(t - stamps[0]) / 1e9, 0.0, 0.0], quarter)))
        for t in (stamps[0] - 100, *stamps[5::5], stamps[-1] + 100)
    ]
    topics = {
        "/tf": [*messages("tf"), *slow],
        "/tf_static": [(stamps[0], transforms((0, "lidar", "base", [0.0, 0.0, -0.5], [0.0, 0.0, 0.0, 1.0])))],
    }
    (found,) = read_estimates(write_bag(tmp_path / "run", topics), topics=["/tf:map.lidar"])
    np.testing.assert_array_equal(found.stamp_ns, POSES.stamp_ns)
    map_odom = transform_from(rotation_from_quaternion(np.array(quarter)), np.zeros(3)) + np.zeros((20, 1, 1))
    map_odom[:, 0, 3] = (POSES.stamp_ns - stamps[0]) / 1e9
    odom_base = transform_from(rotation_from_quaternion(POSES.orientation_xyzw), POSES.position_m)
    expected = map_odom @ odom_base @ transform_from(np.eye(3), np.array([0.0, 0.0, 0.5]))
    np.testing.assert_allclose(found.position_m, expected[:, :3, 3], atol=1e-6)
    assert found.orientation_xyzw is not None
    np.testing.assert_allclose(
        rotation_from_quaternion(found.orientation_xyzw), expected[:, :3, :3], atol=1e-9
    )


@pytest.mark.parametrize(
    ("first_m", "notes"),
    [
        (1.0, ("2 different static transforms from base to lidar; the last one is used, as in tf2",)),
        (0.25, ()),
    ],
)
def test_last_static_transform_holds(tmp_path: Path, first_m: float, notes: tuple[str, ...]) -> None:
    """A publisher that was restarted latches again: tf2 replaces the transform, a note says that it changed."""
    start = int(POSES.stamp_ns[0])
    topics = {
        "/tf": messages("tf"),
        "/tf_static": [
            (start + k, transforms((start + k, "base", "lidar", [x_m, 0.0, 0.0], q)))
            for k, (x_m, q) in enumerate([(first_m, [0.0, 0.0, 0.0, 1.0]), (0.25, [0.0, 0.0, 0.0, -1.0])])
        ],
    }
    (found,) = read_estimates(write_bag(tmp_path / "run", topics), topics=["/tf:odom.lidar"])
    rotation = rotation_from_quaternion(POSES.orientation_xyzw)
    np.testing.assert_allclose(found.position_m, POSES.position_m + 0.25 * rotation[:, :, 0], atol=1e-9)
    assert found.notes == notes


def test_fixes_become_east_north_up(tmp_path: Path) -> None:
    """On the equator at the prime meridian a thousandth of a degree is 111.319 m east; those without a fix are left out."""
    rows = [
        (t, fix(t, 0.0, k * 1e-3, 100.0 + k, status=-1 if k == 3 else 0))
        for k, t in enumerate(POSES.stamp_ns.tolist())
    ]
    (found,) = read_estimates(write_bag(tmp_path / "run", {"/fix": rows}))
    assert len(found.stamp_ns) == 19
    np.testing.assert_allclose(found.position_m[1], [111.3212, 0.0, 0.999], atol=2e-3)
    assert found.covariance is not None
    np.testing.assert_allclose(np.diagonal(found.covariance[0]), [1e-4, 4e-4, 9e-4, 0, 0, 0])
    assert found.notes[1] == "1 pose without numbers (NaN, empty or zero quaternion) left out"


def test_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bag without poses, garbage, a bag of ROS 1, a missing library."""
    empty = write_bag(
        tmp_path / "run", {"/tf_static": [(1, transforms((0, "a", "b", [0] * 3, [0, 0, 0, 1])))]}
    )
    with pytest.raises(InputFileError, match="has no topic with poses"):
        read_estimates(empty)
    (tmp_path / "bad.mcap").write_bytes(b"garbage")
    with pytest.raises(InputFileError, match="is no bag of ROS that can be read"):
        read_estimates(tmp_path / "bad.mcap")
    with pytest.raises(InputFileError, match="rosbags-convert"):
        read_estimates(tmp_path / "old.bag")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(MissingExtraError, match=r"tsgt\[mcap\]"):
        read_estimates(empty)
