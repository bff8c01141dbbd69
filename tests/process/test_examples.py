"""The examples, run as in the documentation."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

from harness.records import EVENT, HELLO, NO_POSE, POSE, SETUP, measurement

from tsgt.recording import encode_line

FOLLOW_STREAM = Path(__file__).parents[2] / "examples" / "follow_stream.py"


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


def test_example_stops_at_another_protocol(tmp_path: Path) -> None:
    """It does not interpret another version of the protocol."""
    code, (line,) = followed(tmp_path, [b'{"type":"hello","protocol":2}'])
    assert code == 1
    assert "has protocol version 2" in line
