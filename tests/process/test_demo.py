"""The demo as a newcomer runs it: a real process, real time, a reader on the socket."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tsgt.recording import load_recording

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def started(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a demo of 6 s and wait until its socket is open."""
    arguments = ["demo", "--duration", "6", "--json"]
    arguments += ["--socket", str(tmp_path / "poses.sock"), "--output", str(tmp_path / "demo.jsonl")]
    process = subprocess.Popen(
        [sys.executable, "-m", "tsgt", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        assert str(tmp_path / "poses.sock") in process.stderr.readline()
        yield process
    finally:
        process.kill()
        process.communicate()


def test_demo_streams_records_and_sums_up(started: subprocess.Popen[str], tmp_path: Path) -> None:
    """A reader gets live poses; at the end the result says how good they were and where the recording is."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(os.fspath(tmp_path / "poses.sock"))
        lines = [json.loads(line) for line in connection.makefile()]
    out, err = started.communicate(timeout=20)
    assert started.returncode == 0, err
    result = json.loads(out)
    assert set(result) == {
        *("poses", "valid_poses", "socket", "recording", "position_rms_mm", "orientation_rms_deg")
    }
    assert result["position_rms_mm"] < 30.0
    assert result["orientation_rms_deg"] < 2.0
    assert 90 < result["valid_poses"] <= result["poses"] <= 120
    assert lines[0]["type"] == "hello"
    assert sum(line["type"] == "pose" and line["valid"] for line in lines) > 80
    assert len(load_recording(tmp_path / "demo.jsonl").measurements) > 30


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_demo_ends_cleanly_on_a_signal(
    started: subprocess.Popen[str], tmp_path: Path, number: signal.Signals
) -> None:
    """Ctrl-C and kill end it with the result so far, exit 0, and no socket left behind."""
    time.sleep(1.0)
    started.send_signal(number)
    out, err = started.communicate(timeout=10)
    assert started.returncode == 0, err
    assert "Traceback" not in err
    assert json.loads(out)["poses"] >= 0
    assert not (tmp_path / "poses.sock").exists()
    load_recording(tmp_path / "demo.jsonl")
