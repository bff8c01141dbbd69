"""One and two stations with an IMU, from the simulated mission to the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt

LIMITS = {
    1: (60, 0.9, 10.0),
    2: (30, 0.9, 4.0),
}  # duration in s, least share of valid predicted poses, greatest rms at the centroid in mm


@pytest.mark.slow
@pytest.mark.parametrize("stations", LIMITS)
def test_few_stations_from_mission_to_report(tsgt: Tsgt, tmp_path: Path, stations: int) -> None:
    """Live poses, processing, report: each command takes such a recording."""
    recording = tmp_path / "few.jsonl"
    duration_s, valid, rms_mm = LIMITS[stations]
    options = ("--stations", stations, "--imu", "industrial", "--duration", duration_s)
    outcome = tsgt("simulate", "dynamic", *options, "--output", recording, "--json")
    assert outcome.code == 0, outcome.err
    live = outcome.json()["live"]
    assert live["predicted"]["valid_poses"] > valid * live["predicted"]["poses"]
    assert 0 < live["predicted_with_imu"]["poses"] <= live["predicted"]["poses"]
    assert live["smoothed"]["centroid"]["position_rms_mm"] < rms_mm
    for arguments in (
        ("process", recording, "--output", tmp_path / "few.csv"),
        ("evaluate", recording, "--no-held-out", "--report", tmp_path / "report"),
    ):
        outcome = tsgt(*arguments)
        assert outcome.code == 0, outcome.err
    assert "do not trust" not in outcome.out + outcome.err
