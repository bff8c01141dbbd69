"""The examples, run as in the documentation."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from harness.files.records import EVENT, HELLO, NO_POSE, POSE, SETUP, STATUS, measurement
from harness.files.stream_lines import lines, serving
from harness.missions.processes import ROOT, TIMEOUT_S, Program

if TYPE_CHECKING:
    from pathlib import Path

FOLLOW_STREAM = ROOT / "examples" / "follow_stream.py"


def followed(tmp_path: Path, *sent: object) -> tuple[int, list[str]]:
    """Serve lines to the example; return its exit code and its output."""
    path = tmp_path / "s"
    with serving(path, lines(*sent)):
        done = subprocess.run(
            [sys.executable, "-I", str(FOLLOW_STREAM), str(path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=TIMEOUT_S,
        )
    return done.returncode, done.stdout.splitlines()


def test_example_follows_the_stream(tmp_path: Path) -> None:
    """The example uses the standard library only and ignores unknown records."""
    records = [HELLO, SETUP, measurement(0), POSE, NO_POSE, EVENT]
    assert followed(tmp_path, *records, b'{"type":"weather"}') == (
        0,
        [
            f"poses of robot in station1; {', '.join(f'station {n} at [0.0, 0.0, 0.0]' for n in (1, 2, 3))}",
            f"{POSE.stamp_ns} ns: 1.000 2.000 -0.100 m, sigma of x 0.0010 m",
            "no pose: outage",
            "event: lost 7 lines",
        ],
    )


def test_example_with_the_client_follows_the_stream(tmp_path: Path) -> None:
    """It goes on after the end of the stream, and tells the gap."""
    predicted = replace(POSE, kind="predicted")
    path, command = (
        tmp_path / "s",
        [sys.executable, str(ROOT / "examples" / "follow_poses.py"), str(tmp_path / "s")],
    )
    first, second = lines(HELLO, measurement(0), NO_POSE, predicted), lines(HELLO, EVENT)
    with serving(path, first, second), Program(command, tmp_path, "example") as example:
        example.wait_for_lines(5)
        printed = example.output.read_text().splitlines()
    assert printed == [
        "no pose: outage",
        f"{POSE.stamp_ns} ns: 1.000 2.000 -0.100 m",
        "gap: some lines (the connection to the master was lost)",
        "event: lost 7 lines",
        "gap: 7 lines (this reader was too slow for the master)",
    ]


def test_example_with_the_client_prints_interpolated_poses(tmp_path: Path) -> None:
    """They wait for the next measurement of each prism, so they are older than predicted ones by nature."""
    now_ns = time.time_ns()
    pose = replace(POSE, kind="interpolated", stamp_ns=now_ns - 800_000_000)
    path, command = (
        tmp_path / "s",
        [sys.executable, str(ROOT / "examples" / "follow_poses.py"), str(tmp_path / "s")],
    )
    served = lines(HELLO, replace(STATUS, stamp_ns=now_ns), pose, EVENT)
    with serving(path, served), Program(command, tmp_path, "example") as example:
        example.wait_for_lines(2)
        printed = example.output.read_text().splitlines()
    assert printed[0] == f"{pose.stamp_ns} ns: 1.000 2.000 -0.100 m"


def test_example_stops_at_another_protocol(tmp_path: Path) -> None:
    """It does not interpret another version of the protocol."""
    code, (line,) = followed(tmp_path, b'{"type":"hello","protocol":2}')
    assert code == 1
    assert "has protocol version 2" in line
