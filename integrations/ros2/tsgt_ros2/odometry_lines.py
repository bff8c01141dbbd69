#!/usr/bin/env python3
"""ROS 2 node that prints the wheel odometry of a robot as lines for tsgt-master; it needs rclpy and nothing of tsgt.

Command of [odometry] in the master's configuration, ROS 2 sourced in the shell:

    command = ["/bin/bash", "-c", ". /opt/ros/jazzy/setup.bash && exec python3 odometry_lines.py --topic /odom --rate-hz 50"]

docs/reference/odometry-program.md specifies the lines. The messages are nav_msgs/Odometry, or with --twist
geometry_msgs/TwistStamped; the twist is that of the wheels alone, in the axes of the robot (REP 105): linear.x in m/s, positive
forwards, and angular.z in rad/s. Odometry into which an IMU or an estimator has been fused would use the IMU twice.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import threading
import time
from typing import Any

FORMAT_VERSION = 1
LINES_PER_S = 10


class Printer:
    """Collects messages into lines.

    ``arrival_stamps``: the driver stamps messages on arrival, so that samples are counted instead.
    """

    def __init__(self, topic: str, rate_hz: float, *, arrival_stamps: bool) -> None:
        self._topic = topic
        self._rate_hz = rate_hz
        self._arrival_stamps = arrival_stamps
        self._per_line = max(1, round(rate_hz / LINES_PER_S))
        self._count = 0
        self._pending: list[tuple[int, int, float, float, bool]] = []

    def hello(self) -> dict[str, Any]:
        """Return the first line."""
        clock = "message count" if self._arrival_stamps else "header.stamp"
        return {
            "type": "hello",
            "odometry": FORMAT_VERSION,
            "make": "ROS 2",
            "model": self._topic,
            "rate_hz": self._rate_hz,
            "clock": clock,
        }

    def add(self, message: Any, host_time_ns: int) -> dict[str, Any] | None:
        """Take a nav_msgs/Odometry or geometry_msgs/TwistStamped; return a line when enough have arrived."""
        stamp = message.header.stamp
        # That of Odometry has a covariance beside it.
        twist = getattr(message.twist, "twist", message.twist)
        speed, yaw_rate = twist.linear.x, twist.angular.z
        valid = math.isfinite(speed) and math.isfinite(yaw_rate)
        if not valid:
            speed = yaw_rate = 0.0
        time_ns = self._count if self._arrival_stamps else stamp.sec * 1_000_000_000 + stamp.nanosec
        self._count += 1
        self._pending.append((time_ns, host_time_ns, speed, yaw_rate, valid))
        if len(self._pending) < self._per_line:
            return None
        times, host_times, speeds, yaw_rates, valids = (
            list(column) for column in zip(*self._pending, strict=True)
        )
        self._pending = []
        return {
            "type": "samples",
            "counter" if self._arrival_stamps else "instrument_time_ns": times,
            "host_time_ns": host_times,
            "speed_mps": speeds,
            "yaw_rate_radps": yaw_rates,
            "valid": valids,
        }


def put(line: dict[str, Any]) -> None:
    """Print a line."""
    sys.stdout.write(json.dumps(line, separators=(",", ":")) + "\n")
    sys.stdout.flush()


def main() -> int:
    """Print lines until stdin ends; return the exit status."""
    parser = argparse.ArgumentParser(
        description="Print the wheel odometry of a robot as lines for tsgt-master."
    )
    parser.add_argument("--topic", default="/odom", help="topic of the messages")
    parser.add_argument("--rate-hz", type=float, required=True, help="nominal rate of the messages")
    parser.add_argument(
        "--twist",
        action="store_true",
        help="the messages are geometry_msgs/TwistStamped instead of nav_msgs/Odometry",
    )
    parser.add_argument(
        "--arrival-stamps",
        action="store_true",
        help="the driver stamps messages on arrival: count them instead",
    )
    arguments = parser.parse_args()

    import rclpy  # noqa: PLC0415 (help works without ROS)
    from rclpy.qos import qos_profile_sensor_data  # noqa: PLC0415

    if arguments.twist:
        from geometry_msgs.msg import TwistStamped as Message  # noqa: PLC0415
    else:
        from nav_msgs.msg import Odometry as Message  # noqa: PLC0415

    printer = Printer(arguments.topic, arguments.rate_hz, arrival_stamps=arguments.arrival_stamps)
    rclpy.init()
    node = rclpy.create_node("tsgt_odometry_lines")

    def received(message: Any) -> None:
        line = printer.add(message, time.monotonic_ns())
        if line is not None:
            put(line)

    def end_with_stdin() -> None:
        sys.stdin.read()
        rclpy.try_shutdown()

    node.create_subscription(Message, arguments.topic, received, qos_profile_sensor_data)
    threading.Thread(target=end_with_stdin, daemon=True).start()
    put(printer.hello())
    while rclpy.ok():
        rclpy.spin_once(node, timeout_sec=0.1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
