"""The examples, run as in the documentation."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from harness.records import EVENT, HELLO, NO_POSE, POSE, SETUP, measurement

from tsgt.recording import encode_line

ROOT = Path(__file__).parents[2]
FOLLOW_STREAM = ROOT / "examples" / "follow_stream.py"


def followed(tmp_path: Path, lines: list[bytes]) -> tuple[int, list[str]]:
    """Serve lines to the example; return its exit code and its output."""
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        with subprocess.Popen(
            [sys.executable, "-I", str(FOLLOW_STREAM), str(path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            listener.settimeout(20)
            connection, _ = listener.accept()
            with connection:
                connection.sendall(b"".join(line + b"\n" for line in lines))
            printed, _ = process.communicate(timeout=20)
    return process.returncode, printed.splitlines()


def test_example_follows_the_stream(tmp_path: Path) -> None:
    """The example uses the standard library only and ignores unknown records."""
    records = [HELLO, SETUP, measurement(0), POSE, NO_POSE, EVENT]
    lines = [*map(encode_line, records), b'{"type":"weather"}']
    assert followed(tmp_path, lines) == (
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
    first = b"".join(encode_line(record) + b"\n" for record in (HELLO, measurement(0), NO_POSE, predicted))
    second = b"".join(encode_line(record) + b"\n" for record in (HELLO, EVENT))
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        with subprocess.Popen(
            [sys.executable, str(ROOT / "examples" / "follow_poses.py"), str(path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        ) as process:
            assert process.stdout is not None
            listener.settimeout(20)
            for data in (first, second):
                connection, _ = listener.accept()
                with connection:
                    connection.sendall(data)
            printed = [process.stdout.readline() for _ in range(5)]
            process.kill()
    assert [line.strip() for line in printed] == [
        "no pose: outage",
        f"{POSE.stamp_ns} ns: 1.000 2.000 -0.100 m",
        "gap: some lines (the connection to the master was lost)",
        "event: lost 7 lines",
        "gap: 7 lines (this reader was too slow for the master)",
    ]


def test_example_stops_at_another_protocol(tmp_path: Path) -> None:
    """It does not interpret another version of the protocol."""
    code, (line,) = followed(tmp_path, [b'{"type":"hello","protocol":2}'])
    assert code == 1
    assert "has protocol version 2" in line
