"""``tsgt simulate``: figures, files and exit codes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.cli.simulate import command
from tsgt.config import ScenarioConfig
from tsgt.recording import load_recording
from tsgt.simulation.checks import Violation
from tsgt.simulation.mission.result import START_UNIX_NS

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt
    from numpy.typing import NDArray

START_S = START_UNIX_NS / 1e9
CLASSIC = ("--protocol", "classic")


@pytest.mark.slow
def test_json_has_the_documented_keys(tsgt: Tsgt) -> None:
    """Classic."""
    found = tsgt("simulate", "dynamic", *CLASSIC, "--stations", 1, "--duration", 20, "--json").json()
    station = found["stations"]["1"]
    assert station.keys() >= {"measured", "delivered", "duplicates", "rate_hz", "time_error_us"}
    assert station.keys() >= {"age_ms", "within_2s", "queued", "missed_slots"}
    assert station["time_error_us"].keys() == {"p50", "p99", "max"}
    assert station["age_ms"].keys() == {"p50", "p99"}
    assert station["measured"] in {41, 42}  # connecting takes three seconds
    assert found["estimators"].keys() == {"linear", "continuous"}
    for estimator in found["estimators"].values():
        assert estimator.keys() >= {
            *("poses", "valid_poses", "position_rms_mm", "orientation_rms_deg", "inter_prism_mean_mm", "nees")
        }
    assert 0.5 < found["airtime_fraction"] <= 1.0
    assert found["violations"] == 0
    assert found["sim_seconds"] == 20
    assert found["wall_seconds"] > 0


@pytest.mark.slow
def test_json_has_the_keys_of_the_superframe(tsgt: Tsgt) -> None:
    """Frames, send queues, missed slots and outages."""
    outcome = tsgt(
        *("simulate", "--stations", 2, "--duration", 20, "--outage", "2:8:4", "--restart", "1:10"),
        *("--drift-ramp-ppm-per-min", 1, "--stamp-jitter-us", 20, "--interference-rate-hz", 0.2, "--json"),
    )
    assert outcome.err.startswith("note: poses need 3 tracked prisms, or an IMU")
    found = outcome.json()
    assert found["protocol"] == "superframe"
    assert found["violations"] == 0
    assert 100 < found["frame_ms"] < 500
    station = found["stations"]["2"]
    assert station["queued"] < 5
    assert station["missed_slots"] >= 0
    (outage,) = found["outages"]
    assert (outage["stations"], outage["start_s"], outage["seconds"]) == ([2], 8, 4)
    assert 0 < outage["drained_s"] < 5
    assert outage["live_age_ms"]["p50"] > 0


@pytest.mark.slow
def test_simulate_as_text(tsgt: Tsgt) -> None:
    """The text has a line per station and the number of violations."""
    result = tsgt("simulate", *CLASSIC, "--stations", 1, "--duration", 16)
    assert result.code == 0
    assert "dynamic, classic (ours), seed 0: 16 s simulated in" in result.out
    assert "violations   0" in result.out


@pytest.mark.slow
def test_recording_and_truth_are_written(tsgt: Tsgt, tmp_path: Path) -> None:
    """The recording can be processed, and the truth covers all its epochs."""
    recording, truth = tmp_path / "run.jsonl", tmp_path / "truth.tum"
    result = tsgt(
        *("simulate", "dynamic", *CLASSIC, "--stations", 1, "--duration", 20),
        *("--output", recording, "--truth", truth, "--json"),
    )
    assert result.code == 0
    kept = load_recording(recording)
    # The drain after the mission adds some measurements.
    assert len(kept.measurements) >= result.json()["stations"]["1"]["delivered"] > 0
    rows = np.loadtxt(truth)
    assert rows.shape == (401, 8)
    np.testing.assert_allclose(np.diff(rows[:, 0]), 0.05, atol=1e-6)


@pytest.mark.slow
def test_figures_follow_from_the_files(tsgt: Tsgt, tmp_path: Path) -> None:
    """Oracle: rates and pose errors computed from recording and truth only."""
    recording, truth = tmp_path / "run.jsonl", tmp_path / "truth.tum"
    arguments = (
        "simulate",
        "dynamic",
        *CLASSIC,
        "--duration",
        60,
        "--output",
        recording,
        "--truth",
        truth,
        "--json",
    )
    found = tsgt(*arguments).json()
    records = [json.loads(line) for line in recording.read_text().splitlines()]
    of = {name: [r for r in records if r["type"] == name] for name in ("clock", "measurement", "pose")}
    true = {
        round(row[0] * 20): (row[1:4], Rotation.from_quat(row[4:]))
        for row in np.loadtxt(truth, converters={0: lambda text: float(text) - START_S})
    }

    first = {clock["station"]: clock["stamp_ns"] / 1e9 - START_S for clock in reversed(of["clock"])}
    synchronised_s = max(first.values())
    for number, station in found["stations"].items():
        arrivals_s = {
            m["host_time_ns"]: m["received_ns"] / 1e9 - START_S
            for m in of["measurement"]
            if m["station"] == int(number)
        }
        counted = sum(synchronised_s <= arrival_s <= 60 for arrival_s in arrivals_s.values())
        assert station["rate_hz"] == pytest.approx(counted / (60 - synchronised_s), rel=1e-6)

    streamed: dict[str, list[dict[str, Any]]] = {}
    for pose in of["pose"]:
        delay = f"_{pose['delay_s']:g}s" if "delay_s" in pose else ""
        streamed.setdefault(pose["kind"] + delay, []).append(pose)
    assert streamed.keys() == found["live"].keys()
    for name, poses in streamed.items():
        _check_poses(found["live"][name], poses, true)
    for estimator, figures in found["estimators"].items():
        output = tmp_path / f"{estimator}.jsonl"
        assert tsgt("process", recording, "--estimator", estimator, "--output", output).code == 0
        poses = [json.loads(line) for line in output.read_text().splitlines()][2:]
        _check_poses(figures, poses, true)


def _check_poses(
    figures: dict[str, Any],
    poses: list[dict[str, Any]],
    true: dict[int, tuple[NDArray[np.float64], Rotation]],
) -> None:
    centroid_m = np.mean([prism.position_m for prism in ScenarioConfig().prisms], axis=0)
    misses_m, centroid_misses_m, turns_rad = [], [], []
    assert figures["poses"] == len(poses)
    assert figures["valid_poses"] == sum(pose["valid"] for pose in poses)
    for pose in poses:
        epoch = round((pose["stamp_ns"] / 1e9 - START_S) * 20)
        if not pose["valid"] or not 2 * 20 <= epoch <= 58 * 20:
            continue
        turn, (position_m, true_turn) = Rotation.from_quat(pose["orientation_xyzw"]), true[epoch]
        misses_m.append(np.array(pose["position_m"]) - position_m)
        centroid_misses_m.append(
            pose["position_m"] + turn.apply(centroid_m) - position_m - true_turn.apply(centroid_m)
        )
        turns_rad.append((turn.inv() * true_turn).magnitude())
    position_rms_mm, centroid_rms_mm = (
        1e3 * np.sqrt(np.mean(np.sum(np.square(each), axis=1))) for each in (misses_m, centroid_misses_m)
    )
    assert figures["position_rms_mm"] == pytest.approx(position_rms_mm, rel=1e-4)
    assert figures["centroid"]["position_rms_mm"] == pytest.approx(centroid_rms_mm, rel=1e-4)
    orientation_rms_deg = np.degrees(np.sqrt(np.mean(np.square(turns_rad))))
    assert figures["orientation_rms_deg"] == pytest.approx(orientation_rms_deg, rel=1e-4)


def test_existing_file_is_not_replaced(tsgt: Tsgt, tmp_path: Path) -> None:
    """Exit code 2 before the mission."""
    recording = tmp_path / "run.jsonl"
    recording.write_text("precious")
    result = tsgt("simulate", "--output", recording)
    assert result.code == 2
    assert "exists; choose another file" in result.err
    assert recording.read_text() == "precious"


@pytest.mark.parametrize("option", ["--output", "--truth"])
def test_missing_folder_is_rejected_before_the_mission(tsgt: Tsgt, tmp_path: Path, option: str) -> None:
    """Exit code 2 before the mission."""
    result = tsgt("simulate", option, tmp_path / "none" / {"--output": "x.jsonl", "--truth": "x.tum"}[option])
    assert result.code == 2
    assert "no such folder" in result.err


@pytest.mark.slow
def test_mission_without_poses_has_dashes(tsgt: Tsgt) -> None:
    """The first synchronisation takes longer than the mission."""
    result = tsgt("simulate", *CLASSIC, "--duration", "3")
    assert result.code == 0
    assert "nan" not in result.out
    assert ["linear", "0", "0", *"------"] in [line.split() for line in result.out.splitlines()]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--station-software", "authors"), "the authors' node speaks classic only"),
        ((*CLASSIC, "--stations", 10), "station 10: classic has station numbers 1 to 9"),
        (("--outage", "4:10:10"), "there is no station 4"),
        (("--restart", "10"), "expected STATION:AT"),
        (("--duration", 20, "--outage", "all:20:5"), "--outage at 20 s: the mission ends at 20 s"),
        (("--duration", 20, "--restart", "master:60"), "--restart at 60 s: the mission ends at 20 s"),
        (("--clock-filter", "paper"), "add --protocol classic"),
        ((*CLASSIC, "--unauthenticated"), "classic never has a key"),
    ],
)
def test_inconsistent_options_are_rejected(tsgt: Tsgt, arguments: tuple[str | int, ...], reason: str) -> None:
    """Exit code 2 before the mission."""
    result = tsgt("simulate", *arguments)
    assert result.code == 2
    assert reason in result.err


def test_unknown_scenario_is_rejected(tsgt: Tsgt) -> None:
    """Exit code 2; the error lists the scenarios."""
    result = tsgt("simulate", "quary")
    assert result.code == 2
    assert "no such scenario; there are dynamic, quarry" in result.err


@pytest.mark.slow
def test_violations_give_exit_code_3(tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch) -> None:
    """Violations are listed up to a limit."""
    planted = [Violation("time", f"planted {number}") for number in range(25)]
    monkeypatch.setattr(command, "check_invariants", lambda _run: planted)
    result = tsgt("simulate", *CLASSIC, "--stations", 1, "--duration", 16)
    assert result.code == 3
    assert "violations   25" in result.out
    assert "time: planted 19" in result.out
    assert "planted 20" not in result.out
    assert "... and 5 more" in result.out
