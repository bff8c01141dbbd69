"""Daemons that are killed at random instants, and what is in their files afterwards."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_killed_daemons_lose_nothing_and_start_again(tmp_path: Path) -> None:
    """Six kills or more, of clients and master, within two seconds of their starts: all that was journalled arrives."""
    done = subprocess.run(
        [
            sys.executable,
            ROOT / "benchmarks" / "kill_loop.py",
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
    # Five of each station after the last kill at least.
    assert counts["measurements recorded"] == counts["measurements journalled"] >= 15
