"""Two computers with a cable between them: network namespaces of this machine; and a master to read from."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from socket import AF_UNIX
from socket import socket as Socket  # noqa: N812 (a class)
from typing import TYPE_CHECKING

from harness.files.records import HELLO, POSE, SETUP
from harness.missions.processes import Program

from tsgt.recording import encode_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

ROBOT_ADDRESS = "10.213.77.1"
READER_ADDRESS = "10.213.77.2"
PERIOD_NS = 50_000_000
IP = shutil.which("ip") or ""
TSGT = (sys.executable, "-m", "tsgt")


def missing() -> str:
    """Return why there can be no network namespaces here; empty if there can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if not IP:
        return "the command ip (iproute2) is not installed"
    probe = f"tsgt-probe-{os.getpid()}"
    if subprocess.run([IP, "netns", "add", probe], capture_output=True, check=False).returncode:
        return "this kernel or container allows no network namespaces"
    subprocess.run([IP, "netns", "del", probe], check=False)
    return ""


@dataclass(frozen=True)
class Network:
    """Two namespaces."""

    robot: str
    reader: str

    def cable(self, *, plugged: bool) -> None:
        """Pull the cable out, or put it in."""
        _ip("-n", self.robot, "link", "set", "cable", "up" if plugged else "down")

    def start(self, namespace: str, command: Sequence[str], folder: Path, name: str) -> Program:
        """Start a program on one of the computers."""
        return Program([IP, "netns", "exec", namespace, *command], folder, name, leads=True)


@contextmanager
def network() -> Iterator[Network]:
    """Make two computers with a cable."""
    pair = Network(f"tsgt-robot-{os.getpid()}", f"tsgt-reader-{os.getpid()}")
    try:
        for namespace in (pair.robot, pair.reader):
            _ip("netns", "add", namespace)
            _ip("-n", namespace, "link", "set", "lo", "up")
        _ip(
            "link", "add", "cable", "netns", pair.robot, "type", "veth", "peer", "cable", "netns", pair.reader
        )
        for namespace, address in ((pair.robot, ROBOT_ADDRESS), (pair.reader, READER_ADDRESS)):
            _ip("-n", namespace, "address", "add", f"{address}/24", "dev", "cable")
            _ip("-n", namespace, "link", "set", "cable", "up")
        yield pair
    finally:
        for namespace in (pair.robot, pair.reader):
            subprocess.run([IP, "netns", "del", namespace], capture_output=True, check=False)


def _ip(*arguments: str) -> None:
    subprocess.run([IP, *arguments], check=True, capture_output=True)


@dataclass
class Master:
    """Sends greeting, set-up and predicted poses at 20 Hz to all readers of a socket; stamps are Unix time."""

    path: Path
    first_ns: int = field(default_factory=lambda: time.time_ns() // PERIOD_NS * PERIOD_NS)
    sent: int = 0
    """Poses that have been sent."""

    def pose_line(self, number: int) -> bytes:
        """Return a pose."""
        return encode_line(replace(POSE, kind="predicted", stamp_ns=self.first_ns + number * PERIOD_NS))

    @contextmanager
    def running(self) -> Iterator[Master]:
        """Run in a thread."""
        stop = threading.Event()
        thread = threading.Thread(target=self._serve, args=(stop,))
        thread.start()
        try:
            yield self
        finally:
            stop.set()
            thread.join()

    def _serve(self, stop: threading.Event) -> None:
        readers: list[Socket] = []
        with Socket(AF_UNIX) as listener:
            listener.bind(str(self.path))
            listener.listen()
            listener.setblocking(False)
            while not stop.is_set():
                with suppress(BlockingIOError):
                    reader, _ = listener.accept()
                    reader.settimeout(1)
                    reader.sendall(encode_line(HELLO) + b"\n" + encode_line(SETUP) + b"\n")
                    readers.append(reader)
                line = self.pose_line(self.sent) + b"\n"
                for reader in list(readers):
                    try:
                        reader.sendall(line)
                    except OSError:
                        readers.remove(reader)
                        reader.close()
                self.sent += 1
                due_ns = self.first_ns + self.sent * PERIOD_NS
                stop.wait(max(0.0, (due_ns - time.time_ns()) / 1e9))
        for reader in readers:
            reader.close()


FOLLOW = """
import sys, time
from tsgt.client import Gap, Hello, Pose, Stream
resume = sys.argv[3:] != ["--no-resume"]
with Stream(sys.argv[1], key=sys.argv[2] or None, resume=resume) as stream:
    for record in stream:
        at_ns = time.time_ns()
        if isinstance(record, Pose):
            print("pose", record.stamp_ns, at_ns, round(record.age_s(), 4))
        elif isinstance(record, Gap):
            print("gap", record.lines, at_ns, record.reason)
        elif isinstance(record, Hello):
            print("hello", record.protocol, at_ns)
"""
"""A program that reads a source (first argument) with a key file (second), and prints what arrives."""


@dataclass(frozen=True)
class Followed:
    """What that program printed."""

    stamps_ns: list[int]
    arrived_ns: list[int]
    ages_s: list[float]
    gaps: list[int | None]
    greetings: int

    @classmethod
    def read(cls, path: Path) -> Followed:
        """Read its output."""
        rows = [line.split() for line in path.read_text().splitlines()]
        poses = [row for row in rows if row[0] == "pose"]
        return cls(
            stamps_ns=[int(row[1]) for row in poses],
            arrived_ns=[int(row[2]) for row in poses],
            ages_s=[float(row[3]) for row in poses],
            gaps=[None if row[1] == "None" else int(row[1]) for row in rows if row[0] == "gap"],
            greetings=sum(row[0] == "hello" for row in rows),
        )
