"""The ROS 2 node that prints an IMU's messages, without ROS: with messages and a client library that only look like it."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from tsgt.imu import HelloLine, SamplesLine, decode_program_line

if TYPE_CHECKING:
    from types import ModuleType

NODE = Path(__file__).parents[2] / "integrations" / "ros2" / "tsgt_ros2" / "imu_lines.py"

RCLPY = """
from types import SimpleNamespace as N
_received, _count = [], 0
def init(): pass
def ok(): return not _done
_done = []
def try_shutdown(): _done.append(True)
def create_node(name):
    return N(create_subscription=lambda kind, topic, callback, qos: _received.append(callback))
def spin_once(node, timeout_sec):
    global _count
    _received[0](N(
        header=N(stamp=N(sec=7, nanosec=_count * 5_000_000)),
        angular_velocity=N(x=0.0, y=0.0, z=0.1), angular_velocity_covariance=[0.0] * 9,
        linear_acceleration=N(x=0.0, y=0.0, z=9.81),
        linear_acceleration_covariance=[COVARIANCE] + [0.0] * 8))
    _count += 1
    if _count == 25:
        try_shutdown()
"""


@pytest.fixture(scope="module")
def node() -> ModuleType:
    """Return the node as a module."""
    spec = importlib.util.spec_from_file_location("imu_lines", NODE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def message(nanosec: int, covariance: float = 0.0) -> SimpleNamespace:
    """Return a message that looks like sensor_msgs/Imu."""
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=7, nanosec=nanosec)),
        angular_velocity=SimpleNamespace(x=0.1, y=0.2, z=0.3),
        angular_velocity_covariance=[covariance] * 9,
        linear_acceleration=SimpleNamespace(x=1.0, y=2.0, z=9.81),
        linear_acceleration_covariance=[0.0] * 9,
    )


@pytest.mark.parametrize("arrival_stamps", [False, True])
def test_messages_become_lines(node: ModuleType, *, arrival_stamps: bool) -> None:
    """Five to a line at 200 Hz, with the stamps of the driver or a count."""
    printer = node.Printer("/imu", 200.0, arrival_stamps=arrival_stamps)
    assert isinstance(decode_program_line(json.dumps(printer.hello()).encode()), HelloLine)
    lines = [printer.add(message(i * 5_000_000), 1000 + i) for i in range(10)]
    (first, second) = (decode_program_line(json.dumps(line).encode()) for line in lines if line is not None)
    assert isinstance(first, SamplesLine)
    assert isinstance(second, SamplesLine)
    assert first.host_time_ns == tuple(range(1000, 1005))
    assert first.angular_rate_radps == ((0.1, 0.2, 0.3),) * 5
    assert first.specific_force_mps2 == ((1.0, 2.0, 9.81),) * 5
    if arrival_stamps:
        assert second.counter == tuple(range(5, 10))
    else:
        assert second.instrument_time_ns == tuple(7_000_000_000 + i * 5_000_000 for i in range(5, 10))


def run(folder: Path, covariance: float) -> subprocess.CompletedProcess[bytes]:
    """Run the node with a client library that delivers 25 messages and ends."""
    for name, text in {
        "rclpy/__init__.py": RCLPY.replace("COVARIANCE", str(covariance)),
        "rclpy/qos.py": "qos_profile_sensor_data = None",
        "sensor_msgs/__init__.py": "",
        "sensor_msgs/msg.py": "Imu = None",
    }.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    environment: dict[str, Any] = os.environ | {"PYTHONPATH": str(folder)}
    with subprocess.Popen(
        [sys.executable, str(NODE), "--rate-hz", "200"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        out, err = process.stdout.read(), process.stderr.read()
    return subprocess.CompletedProcess([], process.returncode, out, err)


def test_node_prints_lines(tmp_path: Path) -> None:
    """Hello first, then samples."""
    done = run(tmp_path, 0.0)
    kinds = [type(decode_program_line(line)) for line in done.stdout.splitlines()]
    assert kinds == [HelloLine, *[SamplesLine] * 5]
    assert done.returncode == 0


def test_node_ends_when_messages_lack_values(tmp_path: Path) -> None:
    """A driver marks what it does not measure with a covariance of -1."""
    done = run(tmp_path, -1.0)
    assert done.returncode == 1
    assert b"/imu/data: the messages have no angular velocity or no linear acceleration" in done.stderr
