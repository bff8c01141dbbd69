"""The commands for recordings on a simulated drive."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.drives.scene import FRAMES, LAYOUT
from harness.files.authors_files import CONSTANTS, write_prisms, write_targets, write_tracks

from tsgt.analysis.formats.export import MEASUREMENT_COLUMNS, POSE_COLUMNS

if TYPE_CHECKING:
    from harness.files.cli import Tsgt

DOCUMENT = Path(__file__).parents[4] / "docs" / "reference" / "evaluate.md"


@pytest.fixture
def recording(tsgt: Tsgt, tmp_path: Path) -> Path:
    """Ten seconds of a drive as raw measurements."""
    path = tmp_path / "drive.jsonl"
    assert (
        tsgt(*importing(tmp_path), "--targets", write_targets(tmp_path), *CONSTANTS, "--output", path).code
        == 0
    )
    return path


def importing(folder: Path) -> list[object]:
    """Return arguments that import simulated tracks, without an output."""
    return ["import", "rts", "--tracks", *write_tracks(folder), "--prisms", write_prisms(folder)]


def lines_of(path: Path) -> list[dict[str, Any]]:
    """Parse the lines of a recording."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_import_summary_agrees_with_the_file(tsgt: Tsgt, tmp_path: Path) -> None:
    """The figures of --json are those of the recording."""
    path = tmp_path / "drive.jsonl"
    result = tsgt(*importing(tmp_path), "--output", path, "--json").json()
    header, parameters, *measurements = lines_of(path)
    assert result["measurements"] == len(measurements) == 75
    assert result["stations"] == {"1": 25, "2": 25, "3": 25}
    assert result["duration_s"] == pytest.approx(9.6 + 0.22)
    assert header["source"] == "import rts: trimble1.csv trimble2.csv trimble3.csv sensor_positions.csv"
    assert {m["type"] for m in measurements} == {"point"}
    assert [p["position_m"] for p in parameters["prisms"]] == LAYOUT.tolist()


def test_import_with_targets_gives_raw_measurements(recording: Path) -> None:
    """Angles and distances are recorded, with frames and prism constants."""
    _, parameters, *measurements = lines_of(recording)
    assert {m["type"] for m in measurements} == {"measurement"}
    frames = [s["T_station1_station"] for s in parameters["stations"]]
    np.testing.assert_allclose(frames, FRAMES, atol=1e-9)
    assert [s["prism_constant_m"] for s in parameters["stations"]] == [0.01] * 3


def test_suffix_tum_selects_a_trajectory(tsgt: Tsgt, recording: Path) -> None:
    """The file has the valid poses only; the summary counts all."""
    output = recording.with_suffix(".tum")
    result = tsgt("process", recording, "--estimator", "linear", "--output", output, "--json").json()
    assert np.loadtxt(output).shape == (result["valid_poses"], 8)
    assert result["valid_poses"] + sum(result["invalid"].values()) == result["poses"]
    assert result["measurements"] == 75
    assert 9.0 < result["duration_s"] < 10.0
    assert 0.0 < result["seconds"] < 10.0


def test_suffix_jsonl_selects_a_recording_of_poses(tsgt: Tsgt, recording: Path) -> None:
    """Header and parameters in force, then all poses with their reasons."""
    output = recording.with_name("poses.jsonl")
    result = tsgt("process", recording, "--estimator", "linear", "--output", output, "--json").json()
    header, parameters, *poses = lines_of(output)
    assert header["source"] == "process: drive.jsonl"
    recorded = lines_of(recording)[1]
    assert parameters == {**recorded, "pipeline": {**recorded["pipeline"], "estimator": "linear"}}
    assert {(pose["type"], pose["kind"]) for pose in poses} == {("pose", "interpolated")}
    assert len(poses) == result["poses"]
    assert sum(pose["valid"] for pose in poses) == result["valid_poses"]
    assert "motion" not in result


@pytest.mark.slow
def test_tuned_motion_prior_is_recorded(tsgt: Tsgt, recording: Path) -> None:
    """The poses are recorded with the parameters that they were computed with, which are also printed."""
    output = recording.with_name("poses.jsonl")
    result = tsgt("process", recording, "--estimator", "continuous", "--output", output, "--json").json()
    _, parameters, *poses = lines_of(output)
    assert {pose["kind"] for pose in poses} == {"smoothed"}
    assert result["estimator"] == parameters["pipeline"]["estimator"] == "continuous"
    assert result["motion_tuned"] is True
    assert result["rest_s"] == 0.0
    assert parameters["pipeline"]["motion"] == result["motion"]
    assert parameters["pipeline"]["noise_scale"] == result["noise_scale"]
    station, factors = parameters["stations"][0], result["noise_scales"]["1"]
    assert [result["noise_scale"] * factor for factor in station["noise_scale"]] == pytest.approx(
        [factors["range"], factors["horizontal_angle"], factors["zenith_angle"]]
    )
    text = tsgt("process", recording, "--estimator", "continuous", "--output", output).out
    assert f"  noise_scale = {result['noise_scale']:.3g}\n  [pipeline.motion]\n" in text
    assert (
        f"  acceleration_correlation_time_s = {result['motion']['acceleration_correlation_time_s']:.3g}\n"
        in text
    )


def test_bytes_of_a_name_that_are_not_utf8_are_replaced(tsgt: Tsgt, recording: Path) -> None:
    """The header of the poses names the recording, whose name a system with Latin-1 has written."""
    named = recording.rename(recording.with_name(os.fsdecode(b"f\xe4.jsonl")))
    output = recording.with_name("poses.jsonl")
    done = tsgt("process", named, "--estimator", "linear", "--output", output)
    assert done.code == 0, done.err
    assert lines_of(output)[0]["source"] == "process: f\ufffd.jsonl"


def test_missing_folder_is_noticed_before_the_computation(
    tsgt: Tsgt, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which may take minutes."""
    monkeypatch.setattr("tsgt.cli.desk.process.load", None)
    output = recording.with_name("none") / "poses.tum"
    done = tsgt("process", recording, "--output", output)
    assert done.code == 1
    assert done.err == f"error: {output}: cannot be written (No such file or directory)\n"


def test_default_estimator_is_the_recorded_one(tsgt: Tsgt, recording: Path) -> None:
    """The estimator in force during the drive is the default."""
    lines = recording.read_text(encoding="utf-8")
    for estimator in ("linear", "continuous"):
        parameters = lines_of(recording)[1]
        parameters["pipeline"]["estimator"] = estimator
        first, _, *others = lines.splitlines()
        recording.write_text("\n".join([first, json.dumps(parameters), *others, ""]), encoding="utf-8")
        result = tsgt("process", recording, "--output", recording.with_suffix(".tum"), "--json").json()
        assert result["estimator"] == estimator


def test_the_rate_sets_the_epochs(tsgt: Tsgt, recording: Path) -> None:
    """5 Hz is every fourth pose of 20 Hz, unchanged."""
    fast, slow = recording.with_name("fast.tum"), recording.with_name("slow.tum")
    tsgt("process", recording, "--estimator", "linear", "--output", fast)
    tsgt("process", recording, "--estimator", "linear", "--rate", 5, "--output", slow)
    fast_lines, few = (
        [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
        for path in (fast, slow)
    )
    every = {line.split()[0]: line for line in fast_lines}
    assert len(few) == pytest.approx(len(every) / 4, abs=1)
    assert all(every[line.split()[0]] == line for line in few)


def test_set_up_files_replace_the_recorded_ones(tsgt: Tsgt, recording: Path) -> None:
    """A layout shifted by 1 m forward moves the robot back by 1 m; stations raised by 5 m raise it."""
    folder = recording.parent
    before, after = folder / "before.tum", folder / "after.tum"
    tables = [f"[prisms.{k}]\nposition_m = {row.tolist()}" for k, row in enumerate(LAYOUT + np.eye(3)[0], 1)]
    (folder / "prisms.toml").write_text("\n".join(['kind = "prism_layout"', *tables]), encoding="utf-8")
    moved = FRAMES.copy()
    moved[:, 2, 3] += 5.0
    tables = [f"[stations.{k}]\nT_station1_station = {frame.tolist()}" for k, frame in enumerate(moved, 1)]
    (folder / "frames.toml").write_text("\n".join(['kind = "station_frames"', *tables]), encoding="utf-8")
    linear = ["--estimator", "linear"]
    assert tsgt("process", recording, *linear, "--output", before).code == 0
    set_up = ["--prisms", folder / "prisms.toml", "--frames", folder / "frames.toml"]
    assert tsgt("process", recording, *linear, *set_up, "--output", after).code == 0
    step = np.loadtxt(after)[:, 1:4] - np.loadtxt(before)[:, 1:4]
    np.testing.assert_allclose(np.linalg.norm(step[:, :2], axis=1), 1.0, atol=1e-3)
    np.testing.assert_allclose(step[:, 2], 5.0, atol=0.02)  # the robot is not quite level


def test_frames_for_points_are_rejected(tsgt: Tsgt, tmp_path: Path) -> None:
    """Points are in the frame of station 1 already, so frames would have no effect."""
    path, frames = tmp_path / "drive.jsonl", tmp_path / "frames.toml"
    tsgt(*importing(tmp_path), "--output", path)
    outcome = tsgt("process", path, "--frames", frames, "--output", tmp_path / "poses.tum")
    assert outcome.code == 2
    assert "--frames has no effect" in outcome.err
    assert not (tmp_path / "poses.tum").exists()


@pytest.mark.slow
def test_evaluate_agrees_for_points_and_raw_measurements(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """The conversion to raw measurements and back changes no distance."""
    points = tmp_path / "points.jsonl"
    tsgt(*importing(tmp_path), "--output", points)
    a, b = (tsgt("evaluate", path, "--no-held-out", "--json").json() for path in (points, recording))
    assert a["epochs"] == b["epochs"]
    for pair in ("1-2", "1-3", "2-3"):
        assert a["inter_prism_mm"][pair]["mean"] == pytest.approx(b["inter_prism_mm"][pair]["mean"], abs=1e-5)


@pytest.mark.slow
def test_evaluate_text_agrees_with_json(tsgt: Tsgt, recording: Path) -> None:
    """The tables have the figures of --json to a hundredth, and every figure is documented."""
    reference = recording.with_name("reference.tum")
    tsgt("process", recording, "--estimator", "linear", "--output", reference)
    options = ("--estimator", "continuous", "--reference", reference)
    result = tsgt("evaluate", recording, *options, "--json").json()
    text = tsgt("evaluate", recording, *options).out
    rows = [line.split() for line in text.splitlines()]

    def row_of(*words: str) -> list[str]:
        return next(row[len(words) :] for row in rows if tuple(row[: len(words)]) == words)

    for pair, values in result["inter_prism_mm"].items():
        assert row_of(pair)[:3] == [
            str(values["valid"]),
            f"{values['reference']:.2f}",
            f"{values['mean']:.2f}",
        ]
    for name, values in result["held_out_mm"].items():
        assert row_of(name) == [
            str(values["n"]),
            *(f"{values[key]:.2f}" for key in ("mean", "median", "p95")),
        ]
    (normalised,) = result["normalised"].values()
    horizontal = normalised["moving"]["horizontal_angle"]
    assert row_of("continuous,", "moving,", "horizontal", "angle") == [
        str(horizontal["n"]),
        *(f"{horizontal[key]:.2f}" for key in ("rms", "robust")),
        f"{horizontal['beyond_3_29_sigma']:.1%}",
    ]
    residuals = result["residuals"]["2"]["zenith_angle"]
    assert row_of("2", "zenith", "angle")[:3] == [
        str(residuals["n"]),
        f"{residuals['mean']:.2f}",
        f"{residuals['std']:.2f}",
    ]
    for name, found in result["estimators"].items():
        assert [name, str(found["compared"]), f"{found['position_rms_mm']:.2f}"] in [row[:3] for row in rows]
    assert result["estimators"]["linear"]["position_rms_mm"] == pytest.approx(0.0, abs=1e-5)
    chosen = result["estimators"]["continuous"]
    assert {key: result[key] for key in chosen} == chosen

    keys = {
        *result,
        *result["inter_prism_mm"]["1-2"],
        *result["inter_prism_static_mm"]["1-2"],
        *result["held_out_mm"]["linear"],
        *normalised,
        *horizontal,
        *result["motion"],
        *residuals,
        *result["residuals"]["2"],
        *chosen,
        *chosen["nees"],
        *("station", "prism", "stamp_ns", "missed_mm", "sigmas"),  # of an outlier
    }
    documented = DOCUMENT.read_text(encoding="utf-8")
    assert {key for key in keys if f"`{key}`" not in documented and f".{key}`" not in documented} == set()


def test_outlier_is_listed(tsgt: Tsgt, recording: Path) -> None:
    """It is listed with station, prism, time and error."""
    lines = recording.read_text(encoding="utf-8").splitlines()
    wrong = json.loads(lines[40])
    wrong["slope_distance_m"] += 1.0
    lines[40] = json.dumps(wrong)
    recording.write_text("\n".join([*lines, ""]), encoding="utf-8")
    outcome = tsgt("evaluate", recording, "--no-held-out", "--json").json()
    (outlier,) = outcome["outliers"]
    assert (outlier["station"], outlier["prism"], outlier["stamp_ns"]) == (
        wrong["station"],
        wrong["prism"],
        wrong["stamp_ns"],
    )
    assert outlier["missed_mm"] == pytest.approx(1000.0, abs=10.0)


def test_export_keeps_recorded_poses(tsgt: Tsgt, recording: Path) -> None:
    """The TUM file equals that of processing."""
    direct, poses, exported = (recording.with_name(name) for name in ("a.tum", "poses.jsonl", "b.tum"))
    tsgt("process", recording, "--output", direct)
    tsgt("process", recording, "--output", poses)
    outcome = tsgt("export", poses, "--format", "tum", "--output", exported)
    assert (outcome.code, outcome.err) == (0, "")
    assert exported.read_bytes() == direct.read_bytes()


def test_export_selects_poses_by_kind(tsgt: Tsgt, recording: Path) -> None:
    """Of predicted and smoothed poses the smoothed ones are exported by default."""
    poses, mixed = recording.with_name("poses.jsonl"), recording.with_name("mixed.jsonl")
    tsgt("process", recording, "--estimator", "continuous", "--output", poses)
    header, parameters, *lines = poses.read_text(encoding="utf-8").splitlines()
    predicted = [line.replace('"smoothed"', '"predicted"') for line in lines]
    both = [line for pair in zip(predicted, lines, strict=True) for line in pair]
    mixed.write_text("\n".join([header, parameters, *both, ""]), encoding="utf-8")
    count = len(tsgt("export", poses, "--format", "csv").out.splitlines())
    for options, expected in (([], count), (["--kind", "predicted"], count), (["--kind", "smoothed"], count)):
        assert len(tsgt("export", mixed, "--format", "csv", *options).out.splitlines()) == expected
    refused = tsgt("export", mixed, "--format", "csv", "--kind", "interpolated")
    assert refused.code == 1
    assert "holds no interpolated poses" in refused.err


def test_export_processes_a_recording_without_poses(tsgt: Tsgt, recording: Path) -> None:
    """A note on stderr says so."""
    direct = recording.with_suffix(".tum")
    tsgt("process", recording, "--output", direct)
    outcome = tsgt("export", recording, "--format", "tum")
    assert outcome.out == direct.read_text(encoding="utf-8")
    assert outcome.err == f"{recording} holds no poses; processing its measurements\n"


@pytest.mark.parametrize(
    ("records", "columns", "count"), [("measurements", MEASUREMENT_COLUMNS, 75), ("poses", POSE_COLUMNS, 190)]
)
def test_export_csv_has_a_row_per_record(
    tsgt: Tsgt, recording: Path, records: str, columns: tuple[str, ...], count: int
) -> None:
    """The header names the columns, and each row has all cells."""
    header, *rows = tsgt("export", recording, "--format", "csv", "--records", records).out.splitlines()
    assert header.split(",") == list(columns)
    assert len(rows) == pytest.approx(count, abs=8)
    assert {row.count(",") for row in rows} == {len(columns) - 1}


def test_tum_of_measurements_is_rejected(tsgt: Tsgt, recording: Path) -> None:
    """The format has no measurements."""
    outcome = tsgt("export", recording, "--format", "tum", "--records", "measurements")
    assert outcome.code == 2
    assert "--format csv" in outcome.err


def test_keep_going_reports_and_skips_a_corrupt_line(tsgt: Tsgt, recording: Path) -> None:
    """Without the option the line is an error with its number."""
    lines = recording.read_text(encoding="utf-8").splitlines(keepends=True)
    recording.write_text("".join([*lines[:10], "garbage\n", *lines[11:]]), encoding="utf-8")
    output = recording.with_suffix(".tum")
    refused = tsgt("process", recording, "--output", output)
    assert refused.code == 1
    assert "line 11" in refused.err
    assert not output.exists()
    outcome = tsgt("process", recording, "--keep-going", "--output", output, "--json")
    assert outcome.json()["measurements"] == 74
    assert outcome.err.startswith("warning: ")
    assert "line 11" in outcome.err


def test_evaluate_prints_the_verdict_first(tsgt: Tsgt, recording: Path) -> None:
    """The tables follow after an empty line."""
    verdict, _, tables = tsgt("evaluate", recording, "--no-held-out").out.partition("\n\n")
    levels = {line.partition(":")[0] for line in verdict.splitlines()}
    assert levels
    assert levels <= {"do not trust", "take care", "good"}
    assert "Distances between prisms" in tables


def test_csv_of_poses(tsgt: Tsgt, recording: Path) -> None:
    """The suffix selects the format; --format overrides it."""
    output = recording.with_suffix(".csv")
    count = tsgt("process", recording, "--estimator", "linear", "--output", output, "--json").json()["poses"]
    header, *rows = output.read_text(encoding="utf-8").splitlines()
    assert header.split(",") == list(POSE_COLUMNS)
    assert len(rows) == count
    other = recording.with_suffix(".txt")
    arguments = ("process", recording, "--estimator", "linear", "--output", other)
    assert tsgt(*arguments).code == 2
    assert tsgt(*arguments, "--format", "csv").code == 0
    assert other.read_bytes() == output.read_bytes()
