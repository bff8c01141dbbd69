"""The ROS 2 node that publishes poses, without ROS: with messages and a client library that only look like it."""

from __future__ import annotations

import importlib.util
import itertools
import sys
from dataclasses import asdict
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from harness.files.records import HELLO, SETUP, STATUS
from harness.readers.web import station

from tsgt.client import Hello, Pose, Setup, StationStatus, Status, records
from tsgt.client.build import build, load
from tsgt.errors import ConfigError
from tsgt.model import Status as MeasurementStatus
from tsgt.recording import LOW_BATTERY_PERCENT, encode_line
from tsgt.recording.conditions import MAX_AGE_S, MAX_UNASKED_S, StationCondition, station_condition

NODE = Path(__file__).parents[2] / "integrations" / "ros2" / "tsgt_ros2" / "pose_publisher.py"

MODULES = (
    "builtin_interfaces.msg", "diagnostic_msgs.msg", "geometry_msgs.msg", "nav_msgs.msg", "rclpy", "rclpy.executors",
    "rclpy.node", "rclpy.qos", "rclpy.signals", "std_msgs.msg", "tf2_msgs.msg",
)  # fmt: skip

NOW_NS = 10**15
OK, WARN, ERROR, STALE = b"\x00", b"\x01", b"\x02", b"\x03"


class RosNode:
    """A node that keeps what it publishes, by topic."""

    parameters: dict[str, str]
    logger: MagicMock

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

    def get_logger(self) -> MagicMock:
        """Return the logger of all nodes of a test."""
        return self.logger

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
    levels = type(
        "DiagnosticStatus", (SimpleNamespace,), {"OK": OK, "WARN": WARN, "ERROR": ERROR, "STALE": STALE}
    )
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
        monkeypatch.setattr(RosNode, "logger", MagicMock(), raising=False)
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


def status(*stations: Any, **changes: Any) -> Status:
    """Return the client's record of a status with these stations."""
    built = (build(StationStatus, asdict(each)) for each in stations)
    return Status(stamp_ns=10**18, poses=5, valid_poses=4, stations=tuple(built), **changes)


def setup(**changes: Any) -> Setup:
    """Return the client's record of a set-up."""
    return build(Setup, load(encode_line(SETUP)) | changes)


def diagnosis(node: Any, name: str = "pose") -> tuple[bytes, str]:
    """Return level and message of the pose, or of another entry, in the diagnostics of now."""
    node._publish_diagnostics()
    (found,) = (each for each in node.published["/diagnostics"][-1].status if each.name == f"tsgt: {name}")
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
    node.take(setup(lag_s=10.0))
    node.take(pose(10.3, kind="smoothed"))
    assert len(node.published["/tsgt/pose"]) == 1
    assert diagnosis(node) == (OK, "good")
    node.take(pose(13.0, kind="smoothed"))
    assert len(node.published["/tsgt/pose"]) == 1
    assert diagnosis(node)[0] == STALE


def test_pose_that_never_came_is_an_error(publisher: Any) -> None:
    """With the reason where the master gives one; without a stream nothing is known."""
    node = publisher()
    node.stream.problem = "no connection yet"
    assert diagnosis(node) == (STALE, "no pose yet")
    node.stream.problem = ""
    node.take(build(Hello, load(encode_line(HELLO))))
    assert diagnosis(node) == (ERROR, "no pose yet")
    node.take(status(no_poses="there is no frames.toml"))
    assert diagnosis(node) == (ERROR, "no poses: there is no frames.toml")
    node.take(setup())
    assert diagnosis(node) == (ERROR, "no pose yet")
    node.take(pose(0.0))
    assert diagnosis(node) == (OK, "good")


def test_pose_of_the_last_session_is_none_of_the_next(publisher: Any) -> None:
    """A master that was restarted has sent no pose yet."""
    node = publisher()
    node.take(pose(0.0))
    node.take(status(station(1)))
    node.take(build(Hello, load(encode_line(HELLO))))
    assert diagnosis(node) == (ERROR, "no pose yet")
    assert [each.name for each in node.published["/diagnostics"][-1].status] == ["tsgt: stream", "tsgt: pose"]


@pytest.mark.parametrize(
    ("kind", "rate_hz", "outage_s", "good_s", "stale_s"),
    [
        ("predicted", 20.0, 1.0, 0.55, 0.65),
        ("predicted", 1.0, 1.0, 2.4, 2.6),
        ("interpolated", 20.0, 5.0, 8.0, 8.2),
        ("smoothed", 0.5, 1.0, 8.9, 9.1),
    ],
)
def test_slow_poses_are_good_until_the_next_is_late(
    publisher: Any, kind: str, rate_hz: float, outage_s: float, good_s: float, stale_s: float
) -> None:
    """Two periods beyond the age of their kind; an interpolated one waits for a measurement, up to the outage limit."""
    node = publisher(series="smoothed" if kind == "smoothed" else "live")
    limits = load(encode_line(SETUP))["limits"] | {"outage_s": outage_s}
    node.take(setup(rate_hz=rate_hz, lag_s=3.0, limits=limits))
    node.take(pose(0.0, kind=kind))
    for age_s, level in ((good_s, OK), (stale_s, STALE)):
        node._pose = pose(age_s, kind=kind)
        assert diagnosis(node)[0] == level


def test_pose_that_came_too_late_is_stale_also_where_poses_are_slow(publisher: Any) -> None:
    """It was not published."""
    node = publisher()
    node.take(setup(rate_hz=0.5))
    node.take(pose(0.6))
    assert node.published["/tsgt/pose"] == []
    assert diagnosis(node) == (STALE, "0.6 s old")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, (OK, "measures")),
        ({"last_heard_s": 60.3, "age_s": 60.8}, (ERROR, "silent for 60 s")),
        ({"last_heard_s": 4.0, "answering": False}, (ERROR, "silent for 4 s")),
        ({"last_heard_s": 4.0, "age_s": 4.2}, (OK, "measures")),
        ({"answering": False}, (OK, "measures")),
        (
            {"last_heard_s": None, "age_s": None, "status": None, "answering": None},
            (ERROR, "not received yet"),
        ),
        ({"age_s": 100.0}, (WARN, "no measurement for 100 s")),
        ({"age_s": None, "status": None}, (WARN, "no measurement yet")),
        ({"status": MeasurementStatus.NO_TARGET}, (WARN, "no prism")),
        ({"battery_percent": 3, "problem": "change its battery"}, (WARN, "change its battery")),
        ({"battery_percent": 3}, (WARN, "battery 3 %")),
        ({"age_s": 100.0, "battery_percent": 3}, (WARN, "no measurement for 100 s; battery 3 %")),
    ],
)
def test_station_is_diagnosed(publisher: Any, changes: dict[str, Any], expected: tuple[bytes, str]) -> None:
    """In the words of ``tsgt status``."""
    node = publisher()
    node.take(status(station(1, **changes)))
    assert diagnosis(node, "station 1") == expected


def test_station_levels_follow_the_conditions_of_all(publisher: Any) -> None:
    """The node is without the package's numpy, so it repeats their rules."""
    node = publisher()
    levels = dict.fromkeys(StationCondition, WARN)
    levels |= {
        StationCondition.NOT_RECEIVED: ERROR,
        StationCondition.SILENT: ERROR,
        StationCondition.TRACKING: OK,
    }
    cases = itertools.product(
        (None, 0.1, MAX_AGE_S - 0.1, MAX_AGE_S + 0.1, MAX_UNASKED_S - 1, MAX_UNASKED_S + 1),
        (None, 0.1, MAX_AGE_S - 0.1, MAX_AGE_S + 0.1),
        (None, True, False),
        (None, *MeasurementStatus),
        (None, LOW_BATTERY_PERCENT - 1, LOW_BATTERY_PERCENT),
    )
    stations = [
        station(
            number, last_heard_s=heard_s, age_s=None if after_s is None else (heard_s or 0.0) + after_s,
            answering=answering, status=last, battery_percent=battery_percent,
        )
        for number, (heard_s, after_s, answering, last, battery_percent) in enumerate(cases, 1)
    ]  # fmt: skip
    node.take(status(*stations))
    diagnosis(node)
    found = {each.name: each.level for each in node.published["/diagnostics"][-1].status}
    for one in stations:
        expected = levels[station_condition(one)]
        if expected == OK and one.action_required:
            expected = WARN
        assert found[f"tsgt: station {one.id}"] == expected, one


def test_stations_are_stale_when_no_status_comes(publisher: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although poses do, as when lines of a later version cannot be read."""
    node = publisher()
    node.take(status(*STATUS.stations))
    later_ns = NOW_NS + 5 * 10**9
    monkeypatch.setitem(type(node).take.__globals__, "monotonic_ns", lambda: later_ns)
    monkeypatch.setattr(records, "monotonic_ns", lambda: later_ns)
    node.take(pose(-5.0))
    assert diagnosis(node) == (OK, "good")
    assert diagnosis(node, "station 1") == (STALE, "no status for 5 s")


def test_frame_of_another_reference_point_is_not_named_robot(publisher: Any) -> None:
    """The prisms hang on the frame `robot`, and would hang on the reference point."""
    node = publisher(robot_frame="robot")
    node.take(setup(child_frame="robot"))
    with pytest.raises(ConfigError, match="robot_frame is 'robot', but poses are those of 'imu_link'"):
        node.take(setup(child_frame="imu_link"))


@pytest.mark.parametrize("source", ["relay://robot:99999", "http://robot"])
def test_wrong_source_is_one_line(publisher: Any, monkeypatch: pytest.MonkeyPatch, source: str) -> None:
    """And the exit code is 1."""
    node = publisher(source=source)
    names = type(node).take.__globals__
    monkeypatch.setitem(names, "signal", MagicMock())
    assert names["main"]() == 1
    ((message,), _) = node.logger.fatal.call_args
    assert message.startswith(f"parameter source: {source}: expected the path of a socket")
