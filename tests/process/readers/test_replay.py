"""``tsgt replay`` as a program of its own."""

from __future__ import annotations

import signal
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.files.records import measurement, recording_bytes
from harness.missions.processes import Program, wait_for

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_replay_that_is_ended_leaves_no_socket(tmp_path: Path, number: signal.Signals) -> None:
    """Also of measurements that fit no robot, over which it takes longer."""
    recording, path = tmp_path / "r.jsonl", tmp_path / "poses.sock"
    stretched = (replace(measurement(n), slope_distance_m=30_000.0 + n) for n in range(50))
    recording.write_bytes(recording_bytes(*stretched))
    replays = [sys.executable, "-m", "tsgt", "replay", "--no-wait"]
    command = [*replays, str(recording), "--socket", str(path)]
    with Program(command, tmp_path, "replay") as replay:
        wait_for(path.exists, replay.process, shows=tmp_path / "replay.err")
        replay.process.send_signal(number)
        replay.process.wait(timeout=30)
    assert not path.exists()
