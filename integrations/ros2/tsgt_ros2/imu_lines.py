#!/usr/bin/env python3
"""ROS 2 node that prints the messages of an IMU as lines for tsgt-master; it needs rclpy and nothing of tsgt.

Command of [imu] in the master's configuration, ROS 2 sourced in the shell:

    command = ["/bin/bash", "-c", ". /opt/ros/jazzy/setup.bash && exec python3 imu_lines.py --topic /imu/data --rate-hz 200"]

docs/reference/imu-program.md specifies the lines. The driver must publish sensor_msgs/Imu with the angular rate in rad/s
and the specific force in m/s^2, gravity included (REP 145).
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from typing import Any

FORMAT_VERSION = 1
LINES_PER_S = 40


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
        self._pending: list[tuple[int, int, list[float], list[float]]] = []

    def hello(self) -> dict[str, Any]:
        """Return the first line."""
        clock = "message count" if self._arrival_stamps else "header.stamp"
        return {
            "type": "hello",
            "imu": FORMAT_VERSION,
            "make": "ROS 2",
            "model": self._topic,
            "rate_hz": self._rate_hz,
            "clock": clock,
        }

    def add(self, message: Any, host_time_ns: int) -> dict[str, Any] | None:
        """Take a sensor_msgs/Imu; return a line when enough have arrived. Raises ValueError if it lacks values."""
        if message.angular_velocity_covariance[0] == -1 or message.linear_acceleration_covariance[0] == -1:
            raise ValueError(
                f"{self._topic}: the messages have no angular velocity or no linear acceleration"
            )
        stamp = message.header.stamp
        rate, force = message.angular_velocity, message.linear_acceleration
        time_ns = self._count if self._arrival_stamps else stamp.sec * 1_000_000_000 + stamp.nanosec
        self._count += 1
        self._pending.append((time_ns, host_time_ns, [rate.x, rate.y, rate.z], [force.x, force.y, force.z]))
        if len(self._pending) < self._per_line:
            return None
        times, host_times, rates, forces = (list(column) for column in zip(*self._pending, strict=True))
        self._pending = []
        return {
            "type": "samples",
            "counter" if self._arrival_stamps else "instrument_time_ns": times,
            "host_time_ns": host_times,
            "angular_rate_radps": rates,
            "specific_force_mps2": forces,
        }


def put(line: dict[str, Any]) -> None:
    """Print a line."""
    sys.stdout.write(json.dumps(line, separators=(",", ":")) + "\n")
    sys.stdout.flush()


def main() -> int:
    """Print lines until stdin ends; return the exit status."""
    parser = argparse.ArgumentParser(description="Print the messages of an IMU as lines for tsgt-master.")
    parser.add_argument("--topic", default="/imu/data", help="topic of sensor_msgs/Imu")
    parser.add_argument("--rate-hz", type=float, required=True, help="nominal rate of the messages")
    parser.add_argument(
        "--arrival-stamps",
        action="store_true",
        help="the driver stamps messages on arrival: count them instead",
    )
    arguments = parser.parse_args()

    import rclpy  # noqa: PLC0415 (help works without ROS)
    from rclpy.qos import qos_profile_sensor_data  # noqa: PLC0415
    from sensor_msgs.msg import Imu  # noqa: PLC0415

    printer = Printer(arguments.topic, arguments.rate_hz, arrival_stamps=arguments.arrival_stamps)
    problems: list[str] = []
    rclpy.init()
    node = rclpy.create_node("tsgt_imu_lines")

    def received(message: Any) -> None:
        try:
            line = printer.add(message, time.monotonic_ns())
        except ValueError as error:
            problems.append(str(error))
            rclpy.try_shutdown()
            return
        if line is not None:
            put(line)

    def end_with_stdin() -> None:
        sys.stdin.read()
        rclpy.try_shutdown()

    node.create_subscription(Imu, arguments.topic, received, qos_profile_sensor_data)
    threading.Thread(target=end_with_stdin, daemon=True).start()
    put(printer.hello())
    while rclpy.ok():
        rclpy.spin_once(node, timeout_sec=0.1)
    for problem in problems:
        sys.stderr.write(problem + "\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
