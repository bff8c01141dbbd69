"""The ROS 2 node that prints wheel odometry, without ROS: with messages and a client library that only look like it."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from tsgt.imu import OdometryHelloLine, OdometryLine, decode_odometry_line

if TYPE_CHECKING:
    from types import ModuleType

NODE = Path(__file__).parents[2] / "integrations" / "ros2" / "tsgt_ros2" / "odometry_lines.py"

RCLPY = """
from types import SimpleNamespace as N
_subscribed, _count = [], 0
def init(): pass
def ok(): return not _done
_done = []
def try_shutdown(): _done.append(True)
def create_node(name):
    return N(create_subscription=lambda kind, topic, callback, qos: _subscribed.append((kind, callback)))
def spin_once(node, timeout_sec):
    global _count
    kind, callback = _subscribed[0]
    twist = N(linear=N(x=0.5, y=0.0, z=0.0), angular=N(x=0.0, y=0.0, z=0.1))
    callback(N(header=N(stamp=N(sec=7, nanosec=_count * 20_000_000)),
               twist=twist if kind == "TwistStamped" else N(twist=twist, covariance=[0.0] * 36)))
    _count += 1
    if _count == 25:
        try_shutdown()
"""


@pytest.fixture(scope="module")
def node() -> ModuleType:
    """Return the node as a module."""
    spec = importlib.util.spec_from_file_location("odometry_lines", NODE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def message(nanosec: int, speed: float = 0.5) -> SimpleNamespace:
    """Return a message that looks like nav_msgs/Odometry."""
    twist = SimpleNamespace(linear=SimpleNamespace(x=speed), angular=SimpleNamespace(z=-0.2))
    stamp = SimpleNamespace(sec=7, nanosec=nanosec)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), twist=SimpleNamespace(twist=twist))


@pytest.mark.parametrize("arrival_stamps", [False, True])
def test_messages_become_lines(node: ModuleType, *, arrival_stamps: bool) -> None:
    """Five to a line at 50 Hz, with the stamps of the driver or a count; what is no number is not valid."""
    printer = node.Printer("/odom", 50.0, arrival_stamps=arrival_stamps)
    assert isinstance(decode_odometry_line(json.dumps(printer.hello()).encode()), OdometryHelloLine)
    speeds = [0.5] * 9 + [math.nan]
    lines = [printer.add(message(i * 20_000_000, speed), 1000 + i) for i, speed in enumerate(speeds)]
    (first, second) = (decode_odometry_line(json.dumps(line).encode()) for line in lines if line is not None)
    assert isinstance(first, OdometryLine)
    assert isinstance(second, OdometryLine)
    assert first.host_time_ns == tuple(range(1000, 1005))
    assert first.speed_mps == (0.5,) * 5
    assert first.yaw_rate_radps == (-0.2,) * 5
    assert second.valid == (True, True, True, True, False)
    if arrival_stamps:
        assert second.counter == tuple(range(5, 10))
    else:
        assert second.instrument_time_ns == tuple(7_000_000_000 + i * 20_000_000 for i in range(5, 10))


@pytest.mark.parametrize("options", [(), ("--twist",)])
def test_node_prints_lines(tmp_path: Path, options: tuple[str, ...]) -> None:
    """Hello first, then samples, of both kinds of messages."""
    for name, text in {
        "rclpy/__init__.py": RCLPY,
        "rclpy/qos.py": "qos_profile_sensor_data = None",
        "nav_msgs/__init__.py": "",
        "nav_msgs/msg.py": "Odometry = 'Odometry'",
        "geometry_msgs/__init__.py": "",
        "geometry_msgs/msg.py": "TwistStamped = 'TwistStamped'",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    environment: dict[str, Any] = os.environ | {"PYTHONPATH": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, str(NODE), "--rate-hz", "50", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    ) as process:
        assert process.stdout is not None
        out = process.stdout.read()
    lines = [decode_odometry_line(line) for line in out.splitlines()]
    assert [type(line) for line in lines] == [OdometryHelloLine, *[OdometryLine] * 5]
    assert process.returncode == 0
