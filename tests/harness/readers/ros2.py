"""The ROS 2 node and a subscriber as real processes of a real distribution, fed by a socket that looks like the master's."""

from __future__ import annotations

import json
import os
import random
import socket
import subprocess
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from harness.files.records import HELLO, PARAMETERS, POSE, STATUS, measurement
from harness.missions.processes import TIMEOUT_S

from tsgt.recording import SetupRecord, encode_line

if TYPE_CHECKING:
    from tsgt.recording import PoseRecord

ROOT = Path(__file__).parents[3]
NODE = ROOT / "integrations" / "ros2" / "tsgt_ros2" / "pose_publisher.py"
SUBSCRIBER = ROOT / "tests" / "interop" / "ros2" / "subscriber.py"
DISTRIBUTIONS = ("jazzy", "kilted")


def environment(distribution: str) -> Path | None:
    """Return the folder of a distribution that `make ros2` has made; None if there is none."""
    folder = ROOT / ".ros2" / distribution
    return folder if (folder / ".complete").exists() else None


@dataclass(frozen=True)
class Received:
    """One message of the subscriber, and when its callback ran (CLOCK_MONOTONIC)."""

    topic: str
    at_ns: int
    message: Any


class RosSystem:
    """A stream's socket, the node that publishes it, and the subscriber."""

    def __init__(self, folder: Path, tmp_path: Path, *parameters: str) -> None:
        self._folder = folder
        self._path = tmp_path / "poses.sock"
        self._parameters = parameters
        self._connection: socket.socket | None = None
        self._received: list[Received] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._listener = self._stack.enter_context(socket.socket(socket.AF_UNIX))
        self._listener.bind(str(self._path))
        self._listener.listen()
        self._listener.settimeout(TIMEOUT_S)
        arguments = [f"source:={self._path}", *self._parameters]
        options = [item for argument in arguments for item in ("-p", argument)]
        self.node = self._run(NODE, "--ros-args", *options)
        self.accept()
        self.subscriber = self._run(SUBSCRIBER)
        reading = threading.Thread(target=self._read)
        self._stack.callback(reading.join, 10)
        self._stack.callback(self.subscriber.terminate)
        reading.start()
        self.wait_for("/tf_static")
        self.wait_for("/diagnostics")
        self._wait_until_all_topics_are_connected()
        return self

    def _wait_until_all_topics_are_connected(self) -> None:
        """Send until everything arrives: the subscriber finds each topic at its own time."""
        rng = random.Random(0)  # noqa: S311 (no secret)
        since_s = time.monotonic()
        moving = ("/tsgt/pose", "/tsgt/odometry", "/tf", "/tsgt/prism1")
        while not all(self.messages(topic) for topic in moving):
            self._check(since_s, "a topic is not connected")
            now = time.time_ns()
            self.send(random_pose(rng, now), replace(measurement(0), stamp_ns=now, received_ns=now))
            time.sleep(0.1)
        time.sleep(0.5)
        self._received[:] = [each for each in self._received if each.topic not in moving]

    def __exit__(self, *_: object) -> None:
        self.hang_up()
        self._stack.close()

    def _run(self, script: Path, *arguments: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [self._folder / "bin" / "python", script, *arguments],
            env={
                **os.environ,
                "PYTHONPATH": str(ROOT),
                "ROS_DOMAIN_ID": str(os.getpid() % 100),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                "ROS_LOG_DIR": str(self._path.parent),
            },
            stdout=subprocess.PIPE,
        )
        assert process.stdout is not None
        self._stack.enter_context(process.stdout)
        self._stack.callback(process.wait, 10)
        self._stack.callback(process.terminate)
        return process

    def _read(self) -> None:
        assert self.subscriber.stdout is not None
        for line in self.subscriber.stdout:
            self._received.append(Received(**json.loads(line)))

    def accept(self) -> None:
        """Accept the node's connection and greet."""
        self._connection, _ = self._listener.accept()
        self.send(HELLO, SetupRecord.of(PARAMETERS, time.time_ns()), STATUS)

    def hang_up(self) -> None:
        """End the stream, as a master that has stopped."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def send(self, *records: object) -> int:
        """Send lines; return the time before on CLOCK_MONOTONIC."""
        assert self._connection is not None
        data = b"".join(encode_line(record) + b"\n" for record in records)
        now = time.monotonic_ns()
        self._connection.sendall(data)
        return now

    def stale_poses(self) -> int:
        """Return how many poses the node has left out because they were too old, by its newest diagnostics."""
        (pose,) = (
            each
            for each in self.messages("/diagnostics")[-1].message["status"]
            if each["name"] == "tsgt: pose"
        )
        return int(next(each["value"] for each in pose["values"] if each["key"] == "stale_poses"))

    def messages(self, topic: str) -> list[Received]:
        """Return what the subscriber has received on a topic so far."""
        return [received for received in list(self._received) if received.topic == topic]

    def wait_for(self, topic: str, count: int = 1) -> list[Received]:
        """Wait until a topic has this number of messages."""
        since_s = time.monotonic()
        while len(found := self.messages(topic)) < count:
            self._check(since_s, f"{topic}: {len(found)} of {count} messages")
            time.sleep(0.02)
        return found

    def _check(self, since_s: float, problem: str) -> None:
        """Fail when node or subscriber has ended, or after too long."""
        ended = [program.args for program in (self.node, self.subscriber) if program.poll() is not None]
        assert not ended, f"{problem}; ended: {ended}"
        assert time.monotonic() - since_s < TIMEOUT_S, problem


def random_pose(rng: random.Random, stamp_ns: int) -> PoseRecord:
    """Return a valid predicted pose of now whose numbers have all their digits."""
    orientation = [rng.gauss(0, 1) for _ in range(4)]
    norm = sum(value * value for value in orientation) ** 0.5
    x, y, z, w = (value / norm for value in orientation)
    return replace(
        POSE,
        kind="predicted",
        stamp_ns=stamp_ns,
        position_m=(rng.gauss(0, 50), rng.gauss(0, 50), rng.gauss(0, 1)),
        orientation_xyzw=(x, y, z, w) if w >= 0 else (-x, -y, -z, -w),
        covariance=tuple(rng.gauss(0, 1e-6) for _ in range(36)),
        velocity_mps=(rng.gauss(0, 1), rng.gauss(0, 1), rng.gauss(0, 1)),
        angular_velocity_radps=(rng.gauss(0, 1), rng.gauss(0, 1), rng.gauss(0, 1)),
    )


def drive(system: RosSystem, seconds: float, rate_hz: float = 20.0) -> tuple[list[PoseRecord], list[int]]:
    """Send poses at a rate, with a status per second; return them with the times at which they were sent."""
    rng = random.Random(1)  # noqa: S311 (no secret)
    poses, sent = [], []
    begin = time.monotonic()
    for number in range(round(seconds * rate_hz)):
        time.sleep(max(0.0, begin + number / rate_hz - time.monotonic()))
        pose = random_pose(rng, time.time_ns())
        poses.append(pose)
        sent.append(system.send(pose))
        if number % round(rate_hz) == 0:
            now = time.time_ns()
            system.send(
                replace(STATUS, stamp_ns=now), replace(measurement(number), stamp_ns=now, received_ns=now)
            )
    return poses, sent
