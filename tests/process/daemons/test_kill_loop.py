"""Daemons killed at random times, and their files afterwards."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_random_kills_lose_nothing(tmp_path: Path) -> None:
    """After six or more kills of clients and master all journalled measurements arrive."""
    done = subprocess.run(
        [
            sys.executable,
            ROOT / "benchmarks" / "run.py",
            "kill_loop",
            "--kills=6",
            "--oldest=2",
            "--seed=3",
            "--json",
        ],
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        check=False,
        text=True,
    )
    result = json.loads(done.stdout)
    assert result["violations"] == []
    assert done.returncode == 0
    counts = result["counts"]
    assert counts["kills"] >= 6
    # At least five of each station after the last kill.
    assert counts["measurements recorded"] == counts["measurements journalled"] >= 15
