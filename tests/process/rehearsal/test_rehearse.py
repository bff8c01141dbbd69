"""``tsgt rehearse``: the day played by a script, with real daemons and commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from harness.missions.processes import ROOT


def test_day_is_played_from_start_to_end(tmp_path: Path) -> None:
    """Without a calibration, targets collected, frames applied while the master runs, a lost prism noticed, the debriefing."""
    command = ["rehearse", "--auto", "--incident", "prism", "--drive", "8", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "tsgt", *command],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        timeout=540,
    )
    assert done.returncode in (0, 3), done.stderr
    found = json.loads(done.stdout)
    assert "NOT CALIBRATED: no poses" in done.stderr
    assert "targets.csv: complete" in done.stderr
    assert "the running master uses it: new set-up in force: frames of stations 1, 2, 3" in done.stderr
    (incident,) = found["incidents"]
    assert incident["what"] == "line of sight of station 3 blocked"
    assert incident["noticed_after_s"] is not None
    assert incident["over_after_s"] > incident["noticed_after_s"]
    assert "setup_applied" in found["events"]
    # A busy computer makes poses few, and none of them wrong.
    assert found["parts"]["drive"]["position_rms_mm"] < 30.0
    assert not (Path(found["folder"]) / "orders").exists()
