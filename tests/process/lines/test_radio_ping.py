"""``tsgt radio ping`` as a process."""

from __future__ import annotations

import signal
import subprocess
import sys


def test_ctrl_c_prints_the_summary_so_far() -> None:
    """The exit code is 0."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tsgt", "radio", "ping", "--simulated", "--count", "65536"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    for _ in range(10):
        assert "here" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    first, second, *_ = out.splitlines()
    assert 10 <= int(first.split()[1]) < 65536
    assert int(second.split()[1]) >= 10
