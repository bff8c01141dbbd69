"""``tsgt demo``: real daemons, real sockets, real time, and killed daemons."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from harness.missions.processes import TIMEOUT_S

from tsgt.model import PolarMeasurement
from tsgt.recording import load_recording
from tsgt.recording.journal import load_journal


@dataclass
class Demo:
    """A running demo and its output so far."""

    process: subprocess.Popen[str]
    said: list[str] = field(default_factory=list)

    def follow(self) -> None:
        """Read the output until its end."""
        assert self.process.stderr is not None
        self.said.extend(self.process.stderr)

    def pids(self) -> dict[str, int]:
        """Return the latest process ids of the daemons."""
        lines = [line for line in self.said if line.startswith("processes")]
        return (
            {name: int(pid) for name, pid in re.findall(r"(\w+(?: \d)?): (\d+)", lines[-1])} if lines else {}
        )

    def valid_poses(self) -> int:
        """Return the reported number of valid poses."""
        counts = [re.search(r"(\d+)/\d+ poses valid", line) for line in self.said]
        return max((int(count[1]) for count in counts if count), default=0)

    def wait_for_poses(self, more_than: int) -> None:
        """Wait until it has reported more valid poses."""
        deadline_s = time.monotonic() + TIMEOUT_S
        while self.valid_poses() <= more_than:
            assert time.monotonic() < deadline_s, "".join(self.said)
            assert self.process.poll() is None, "".join(self.said)
            time.sleep(0.1)

    def connect(self, path: Path) -> socket.socket:
        """Connect to the stream as soon as the master listens."""
        deadline_s = time.monotonic() + TIMEOUT_S
        while True:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                connection.connect(os.fspath(path))
            except OSError:
                connection.close()
            else:
                return connection
            assert time.monotonic() < deadline_s, "".join(self.said)
            assert self.process.poll() is None, "".join(self.said)
            time.sleep(0.1)


Start = Callable[..., Demo]


@pytest.fixture
def folder() -> Iterator[Path]:
    """Return a folder with a short path: sockets have a length limit."""
    with tempfile.TemporaryDirectory(prefix="demo-") as path:
        yield Path(path)


@pytest.fixture
def start(folder: Path) -> Iterator[Start]:
    """Return a function that starts a demo with additional arguments."""
    with ExitStack() as stack:

        def begin(*arguments: str) -> Demo:
            command = [
                sys.executable,
                "-m",
                "tsgt",
                "demo",
                "--json",
                "--socket",
                str(folder / "poses.sock"),
            ]
            process = stack.enter_context(
                subprocess.Popen(
                    [*command, *arguments],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    env={**os.environ, "TMPDIR": str(folder)},
                )
            )
            demo = Demo(process)
            following = threading.Thread(target=demo.follow)
            following.start()
            stack.callback(following.join)
            stack.callback(process.kill)
            return demo

        yield begin


def _end(demo: Demo) -> dict[str, object]:
    assert demo.process.stdout is not None
    out = demo.process.stdout.read()
    assert demo.process.wait(TIMEOUT_S) == 0, "".join(demo.said)
    result = json.loads(out)
    assert isinstance(result, dict)
    return result


@pytest.mark.parametrize("protocol", ["superframe", "classic"])
def test_demo_streams_records_and_summarises(start: Start, folder: Path, protocol: str) -> None:
    """A reader gets live poses; the result has errors and the recording."""
    output = folder / "kept.jsonl"
    demo = start("--protocol", protocol, "--duration", "16", "--output", str(output))
    with demo.connect(folder / "poses.sock") as connection:
        lines = [json.loads(line) for line in connection.makefile()]
    result = _end(demo)
    assert {
        *("poses", "valid_poses", "socket", "recording", "position_rms_mm", "orientation_rms_deg")
    } <= set(result)
    assert result["recording"] == str(output)
    assert isinstance(result["valid_poses"], int)
    assert result["valid_poses"] > 50
    assert isinstance(result["position_rms_mm"], float)
    assert result["position_rms_mm"] < 60.0
    assert isinstance(result["live"], dict)
    assert result["live"].keys() == {"predicted", "smoothed", "smoothed_1s"}
    assert lines[0]["type"] == "hello"
    assert any(line["type"] == "pose" and line["valid"] for line in lines)
    statuses = [line for line in lines if line["type"] == "status"]
    assert statuses
    assert all(len(status["stations"]) == 3 for status in statuses)
    assert {(s["protocol"], s["authenticated"]) for s in statuses} == {(protocol, protocol == "superframe")}
    assert len(load_recording(output).measurements) > 20


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, signal.SIGTERM],
    ids=lambda number: number.name,
)
def test_demo_ends_cleanly_on_a_signal(start: Start, folder: Path, number: signal.Signals) -> None:
    """SIGINT and SIGTERM end demo and daemons with the result so far, exit 0, and no socket left."""
    demo = start("--duration", "60")
    deadline_s = time.monotonic() + TIMEOUT_S
    while not demo.pids():
        assert demo.process.poll() is None, "".join(demo.said)
        assert time.monotonic() < deadline_s, "".join(demo.said)
        time.sleep(0.1)
    pids = demo.pids()
    demo.process.send_signal(number)
    result = _end(demo)
    assert "Traceback" not in "".join(demo.said)
    assert isinstance(result["poses"], int)
    assert not (folder / "poses.sock").exists()
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids.values())


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--socket", "{}/" + 90 * "long"), "at most 107 bytes"),
        (("--socket", "{}"), "is not a socket"),
        (("--output", "{}/none/x.jsonl"), "no such folder"),
    ],
)
def test_invalid_options_fail_at_once(
    start: Start, folder: Path, arguments: tuple[str, str], reason: str
) -> None:
    """Not after a minute without poses, nor after the run."""
    demo = start(arguments[0], arguments[1].format(folder))
    assert demo.process.wait(TIMEOUT_S) in {1, 2}
    assert demo.process.stdout is not None
    assert not demo.process.stdout.read()
    deadline_s = time.monotonic() + TIMEOUT_S
    while reason not in "".join(demo.said):
        assert time.monotonic() < deadline_s, "".join(demo.said)
        time.sleep(0.01)


def test_daemons_end_with_a_killed_demo(start: Start) -> None:
    """SIGKILL of the demo leaves no process."""
    demo = start("--duration", "60")
    deadline_s = time.monotonic() + TIMEOUT_S
    while not demo.pids():
        assert demo.process.poll() is None, "".join(demo.said)
        assert time.monotonic() < deadline_s, "".join(demo.said)
        time.sleep(0.1)
    pids = demo.pids().values()
    demo.process.kill()
    # Orphans that nobody waits for may stay as zombies where PID 1 is no init: those have no command line.
    while any(_command_line(pid) for pid in pids):
        assert time.monotonic() < deadline_s
        time.sleep(0.1)


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def _delivered(folder: Path) -> set[tuple[int, int]]:
    """Return station and number of all recorded measurements."""
    return {
        (m.station, m.sequence)
        for path in (folder / "recordings").glob("master-*.jsonl")
        for m in load_recording(path).measurements
        if isinstance(m, PolarMeasurement)
    }


def _journalled(folder: Path, station: int) -> dict[int, int]:
    """Return the stamps of all journalled measurements by number."""
    return {
        m.sequence: m.stamp_ns
        for path in sorted((folder / f"journals{station}").glob("*.jsonl"))
        for m in load_journal(path).measurements
    }


def test_killed_daemons_restart_without_loss(start: Start, folder: Path) -> None:
    """After SIGKILL of each daemon poses continue, and every journalled measurement is delivered."""
    demo = start("--duration", "120")
    demo.wait_for_poses(20)
    for name in ("client 2", "master"):
        before = demo.valid_poses()
        os.kill(demo.pids()[name], signal.SIGKILL)
        demo.wait_for_poses(before + 60)
    (made,) = folder.glob("tsgt-demo-*")
    read_by_then = {(station, number) for station in (1, 2, 3) for number in _journalled(made, station)}
    deadline_s = time.monotonic() + TIMEOUT_S
    while not read_by_then <= _delivered(made):
        assert time.monotonic() < deadline_s, sorted(read_by_then - _delivered(made))
        time.sleep(0.5)
    demo.process.send_signal(signal.SIGINT)
    result = _end(demo)
    assert Path(str(result["folder"])) == made
    assert result["restarts"] == 2
    assert len(list((made / "recordings").glob("master-*.jsonl"))) == 2
    read = set()
    for station, journals in ((1, 1), (2, 2), (3, 1)):
        assert len(list((made / f"journals{station}").glob("*.jsonl"))) == journals
        stamps_ns = _journalled(made, station)
        read |= {(station, number) for number in stamps_ns}
        gaps_s = [(after - before) / 1e9 for before, after in itertools.pairwise(sorted(stamps_ns.values()))]
        # 2.5 Hz; the only long gap is the time in which there was no client, whatever else this machine is doing.
        assert sum(gap_s > 3.0 for gap_s in gaps_s) == journals - 1
    assert _delivered(made) <= read
    assert len(read_by_then) > 60
