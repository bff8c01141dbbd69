"""The ROS 2 node that publishes poses, without ROS: with messages and a client library that only look like it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from tsgt.client import Pose, records

NODE = Path(__file__).parents[2] / "integrations" / "ros2" / "tsgt_ros2" / "pose_publisher.py"

MODULES = (
    "builtin_interfaces.msg", "diagnostic_msgs.msg", "geometry_msgs.msg", "nav_msgs.msg", "rclpy", "rclpy.executors",
    "rclpy.node", "rclpy.qos", "rclpy.signals", "std_msgs.msg", "tf2_msgs.msg",
)  # fmt: skip

NOW_NS = 10**15
OK, ERROR, STALE = b"\x00", b"\x02", b"\x03"


class RosNode:
    """A node that keeps what it publishes, by topic."""

    parameters: dict[str, str]

    def __init__(self, _name: str) -> None:
        self.published: dict[str, list[Any]] = {}

    def declare_parameter(self, name: str, default: Any = None, *, value: Any = None) -> SimpleNamespace:
        """Return what the test has set, or the default."""
        return SimpleNamespace(value=self.parameters.get(name, default if value is None else value))

    def create_publisher(self, _type: Any, topic: str, _qos: Any) -> SimpleNamespace:
        """Return a publisher that keeps its messages."""
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def create_timer(self, _period_s: float, _callback: Any) -> None:
        """Make none: the test calls."""

    def get_clock(self) -> Any:
        """Return a clock whose time nobody looks at."""
        return MagicMock()


@pytest.fixture
def publisher(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what makes a node with parameters, connected to a stream."""
    for name in MODULES:
        monkeypatch.setitem(sys.modules, name, MagicMock())
    monkeypatch.setattr(sys.modules["rclpy.node"], "Node", RosNode)
    diagnostics = sys.modules["diagnostic_msgs.msg"]
    levels = type("DiagnosticStatus", (SimpleNamespace,), {"OK": OK, "ERROR": ERROR, "STALE": STALE})
    monkeypatch.setattr(diagnostics, "DiagnosticStatus", levels)
    monkeypatch.setattr(diagnostics, "DiagnosticArray", SimpleNamespace)
    spec = importlib.util.spec_from_file_location("pose_publisher", NODE)
    assert spec is not None
    assert spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "monotonic_ns", lambda: NOW_NS)
    monkeypatch.setattr(records, "monotonic_ns", lambda: NOW_NS)

    def make(**parameters: str) -> Any:
        monkeypatch.setattr(RosNode, "parameters", parameters, raising=False)
        node = module.PosePublisher()
        node.stream = SimpleNamespace(problem="")
        return node

    return make


def pose(age_s: float, **changes: Any) -> Pose:
    """Return a valid pose of this age."""
    fields: dict[str, Any] = {
        "stamp_ns": 10**18, "frame": "station1", "child_frame": "robot", "position_m": (0.0, 0.0, 0.0),
        "orientation_xyzw": (0.0, 0.0, 0.0, 1.0), "covariance": None, "velocity_mps": None, "angular_velocity_radps": None,
        "estimator": "continuous", "kind": "predicted", "valid": True, "reason": "", "quality": "good", "residual_m": None,
        "stations": (), "epoch_ns": NOW_NS - round(age_s * 1e9),
    }  # fmt: skip
    return Pose(**fields | changes)


def diagnosis(node: Any) -> tuple[bytes, str]:
    """Return level and message of the pose in the diagnostics of now."""
    node._publish_diagnostics()
    (found,) = (each for each in node.published["/diagnostics"][-1].status if each.name == "tsgt: pose")
    return found.level, found.message


def test_pose_of_now_is_published_and_good(publisher: Any) -> None:
    """The diagnostics say so."""
    node = publisher()
    node.take(pose(0.0))
    assert len(node.published["/tsgt/pose"]) == 1
    assert diagnosis(node) == (OK, "good")


@pytest.mark.parametrize("valid", [True, False])
def test_late_pose_is_neither_published_nor_good(publisher: Any, *, valid: bool) -> None:
    """One that comes a second late says nothing of the present, whatever it says of itself."""
    node = publisher()
    node.take(pose(1.0, valid=valid, reason="" if valid else "outage"))
    assert node.published["/tsgt/pose"] == []
    assert diagnosis(node) == (STALE, "1.0 s old")


def test_last_pose_is_not_good_for_ever(publisher: Any) -> None:
    """When no other follows, although the stream goes on."""
    node = publisher()
    node.take(pose(0.4))
    assert len(node.published["/tsgt/pose"]) == 1
    node._pose = pose(60.0)
    assert diagnosis(node) == (STALE, "60.0 s old")


def test_final_pose_may_be_as_old_as_the_lag_of_the_set_up(publisher: Any) -> None:
    """A master with a longer lag sends them later."""
    node = publisher(series="smoothed")
    node._setup = SimpleNamespace(lag_s=10.0)
    node.take(pose(10.3, kind="smoothed"))
    assert len(node.published["/tsgt/pose"]) == 1
    assert diagnosis(node) == (OK, "good")
    node.take(pose(13.0, kind="smoothed"))
    assert len(node.published["/tsgt/pose"]) == 1
    assert diagnosis(node)[0] == STALE
