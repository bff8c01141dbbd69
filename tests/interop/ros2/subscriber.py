"""Runs with rclpy: prints each message of the topics of tsgt as a JSON line with the time at which its callback ran."""

from __future__ import annotations

import functools
import json
import sys
import time
from contextlib import suppress
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

TOPICS = {
    "/tsgt/pose": PoseWithCovarianceStamped,
    "/tsgt/odometry": Odometry,
    "/tsgt/prism1": PointStamped,
    "/tf": TFMessage,
    "/tf_static": TFMessage,
    "/diagnostics": DiagnosticArray,
}


def plain(message: Any) -> Any:
    """Return a message as JSON values."""
    if hasattr(message, "get_fields_and_field_types"):
        return {name: plain(getattr(message, name)) for name in message.get_fields_and_field_types()}
    if isinstance(message, bytes):
        return list(message)
    if isinstance(message, (str, int, float, bool)):
        return message
    return [plain(item) for item in message]


def received(topic: str, message: Any) -> None:
    """Print one message."""
    now = time.monotonic_ns()
    sys.stdout.write(json.dumps({"topic": topic, "at_ns": now, "message": plain(message)}) + "\n")
    sys.stdout.flush()


rclpy.init()
node = rclpy.create_node("subscriber")
for name, kind in TOPICS.items():
    durability = DurabilityPolicy.TRANSIENT_LOCAL if name == "/tf_static" else DurabilityPolicy.VOLATILE
    profile = QoSProfile(depth=1000, durability=durability)
    node.create_subscription(kind, name, functools.partial(received, name), profile)
with suppress(ExternalShutdownException):
    rclpy.spin(node)
