"""The command ``simulate``: its figures, its files, its exit codes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.cli import simulate
from tsgt.recording import load_recording
from tsgt.simulation.checkers import Violation

if TYPE_CHECKING:
    from pathlib import Path

    import pytest
    from support.cli import Tsgt


def test_the_keys_that_others_rely_on(tsgt: Tsgt) -> None:
    """Machines find everything under the names that are promised."""
    found = tsgt("simulate", "dynamic", "--stations", 1, "--duration", 20, "--json").json()
    station = found["stations"]["1"]
    assert station.keys() >= {"measured", "delivered", "duplicates", "rate_hz", "time_error_us"}
    assert station["time_error_us"].keys() == {"p50", "p99", "max"}
    assert station["measured"] == 50
    assert found["estimators"]["linear"].keys() >= {
        "position_rms_mm",
        "orientation_rms_deg",
        "inter_prism_mean_mm",
    }
    assert 0.5 < found["airtime_fraction"] <= 1.0
    assert found["violations"] == 0
    assert found["sim_seconds"] == 20
    assert found["wall_seconds"] > 0


def test_the_text(tsgt: Tsgt) -> None:
    """People get a line for each station, and how many violations there were."""
    result = tsgt("simulate", "--stations", 1, "--duration", 16)
    assert result.code == 0
    assert "dynamic, classic (ours), seed 0: 16 s simulated in" in result.out
    assert "violations   0" in result.out


def test_recording_and_truth_are_kept(tsgt: Tsgt, tmp_path: Path) -> None:
    """The recording can be processed, and the truth is there for each of its epochs."""
    recording, truth = tmp_path / "run.jsonl", tmp_path / "truth.tum"
    result = tsgt(
        *("simulate", "dynamic", "--stations", 1, "--duration", 20),
        *("--output", recording, "--truth", truth, "--json"),
    )
    assert result.code == 0
    kept = load_recording(recording)
    # The run goes on for a few seconds in which what is under way arrives.
    assert len(kept.measurements) >= result.json()["stations"]["1"]["delivered"] > 0
    rows = np.loadtxt(truth)
    assert rows.shape == (401, 8)
    np.testing.assert_allclose(np.diff(rows[:, 0]), 0.05, atol=1e-6)


def test_existing_files_are_not_replaced(tsgt: Tsgt, tmp_path: Path) -> None:
    """A recording of an earlier run stays what it is."""
    recording = tmp_path / "run.jsonl"
    recording.write_text("precious")
    result = tsgt("simulate", "--output", recording)
    assert result.code == 2
    assert "exists; choose another file" in result.err
    assert recording.read_text() == "precious"


def test_an_unknown_scenario(tsgt: Tsgt) -> None:
    """A name that nobody knows is a mistake of usage, answered with the names that there are."""
    result = tsgt("simulate", "quary")
    assert result.code == 2
    assert "no such scenario; there are dynamic, quarry" in result.err


def test_violations_make_the_check_fail(tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch) -> None:
    """What must not happen is listed, not without end, and the exit code is 3."""
    planted = [Violation("time", f"planted {number}") for number in range(25)]
    monkeypatch.setattr(simulate, "violations", lambda _run: planted)
    result = tsgt("simulate", "--stations", 1, "--duration", 16)
    assert result.code == 3
    assert "violations   25" in result.out
    assert "time: planted 19" in result.out
    assert "planted 20" not in result.out
    assert "... and 5 more" in result.out
