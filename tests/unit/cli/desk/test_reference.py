"""``tsgt evaluate --reference --align``, and a reference of another time."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.authors_files import write_prisms, write_tracks

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt


@pytest.fixture
def recording(tsgt: Tsgt, tmp_path: Path) -> Path:
    """Ten seconds of driving, as points."""
    path = tmp_path / "drive.jsonl"
    sources = ("--tracks", *write_tracks(tmp_path), "--prisms", write_prisms(tmp_path))
    assert tsgt("import", "rts", *sources, "--output", path).code == 0
    return path


@pytest.mark.slow
def test_alignment_agrees_with_evo(
    tsgt: Tsgt, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To 1e-6 m and 1e-6 degrees with evo_ape -a (Umeyama without scale); unaligned errors are printed as well."""
    monkeypatch.setenv("HOME", str(tmp_path))  # evo writes its settings there when it is first imported
    metrics = pytest.importorskip("evo.core.metrics")
    sync = pytest.importorskip("evo.core.sync")
    read = pytest.importorskip("evo.tools.file_interface").read_tum_trajectory_file
    files: dict[str, Any] = {name: tmp_path / f"{name}.tum" for name in ("linear", "continuous")}
    for name, path in files.items():
        assert tsgt("process", recording, "--estimator", name, "--output", path).code == 0
    arguments = ("--estimator", "linear", "--reference", files["continuous"], "--no-held-out", "--json")
    unaligned = tsgt("evaluate", recording, *arguments).json()
    ours = tsgt("evaluate", recording, *arguments, "--align", "rigid").json()

    reference, found = read(str(files["continuous"])), read(str(files["linear"]))
    found.reduce_to_time_range(reference.timestamps[0] + 2.0, reference.timestamps[-1] - 2.0)
    pair = sync.associate_trajectories(reference, found, max_diff=1e-6)
    pair[1].align(pair[0])

    def rms(relation: Any) -> float:
        ape = metrics.APE(relation)
        ape.process_data(pair)
        return float(ape.get_statistic(metrics.StatisticsType.rmse))

    aligned = ours["aligned"]
    assert {key: ours[key] for key in ("position_rms_mm", "orientation_rms_deg")} == {
        key: unaligned[key] for key in ("position_rms_mm", "orientation_rms_deg")
    }
    assert "aligned" not in unaligned
    assert 0.0 < aligned["position_rms_mm"] < ours["position_rms_mm"]
    assert aligned["hidden_position_mm"] == pytest.approx(
        ours["position_rms_mm"] - aligned["position_rms_mm"]
    )
    relation = metrics.PoseRelation
    assert rms(relation.translation_part) == pytest.approx(aligned["position_rms_mm"] / 1e3, abs=1e-6)
    assert rms(relation.rotation_angle_deg) == pytest.approx(aligned["orientation_rms_deg"], abs=1e-6)
    text = tsgt("evaluate", recording, *arguments[:-1], "--align", "translation").out
    at = "positions at the robot's origin and at the prisms' centroid"
    assert f"unaligned; {at}" in text
    aligned_title = (
        "Aligned (translation): remaining error, alignment, and the part of the error that it hides"
    )
    assert f"{aligned_title}; {at}" in text


def test_every_table_of_errors_names_its_points(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """In its title and in each column of positions: the reference point, or the prisms' centroid."""
    reference = tmp_path / "linear.tum"
    assert tsgt("process", recording, "--estimator", "linear", "--output", reference).code == 0
    arguments = ("--no-held-out", "--reference", reference, "--align", "rigid", "--point", "lidar=1,2,3")
    text = tsgt("evaluate", recording, *arguments).out
    titles, headers = zip(*(table.strip().splitlines()[:2] for table in text.split("\n\n")[-3:]), strict=True)
    assert all("positions at lidar and at the prisms' centroid" in title for title in titles[:2])
    assert "of pairs of poses, at lidar" in titles[2]
    for header in headers:
        columns = [column for column in re.split(r"  +", header) if " mm" in column and column != "shift mm"]
        assert len(columns) >= 2
        assert all(column.startswith(("lidar ", "centroid ")) for column in columns), header
    verdict = next(line for line in text.splitlines() if "stated position sigma" in line)
    assert "at lidar is" in verdict


def test_unknown_point_of_the_reference_is_an_error(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """That names its own option, not that of the poses."""
    reference = tmp_path / "truth.tum"
    reference.write_text("1600000000 0 0 0 0 0 0 1\n1600000100 0 0 0 0 0 0 1\n", encoding="utf-8")
    arguments = ("--no-held-out", "--reference", reference, "--reference-point", "lidar")
    outcome = tsgt("evaluate", recording, *arguments)
    assert outcome.code == 2
    assert "--reference-point: there is no point 'lidar'; there are robot, centroid" in outcome.err


def test_reference_of_another_day_is_an_error(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """The error names both time spans; no figures are printed."""
    reference = tmp_path / "other.tum"
    reference.write_text("1600000000 0 0 0 0 0 0 1\n1600000100 0 0 0 0 0 0 1\n", encoding="utf-8")
    outcome = tsgt("evaluate", recording, "--no-held-out", "--reference", reference, "--json")
    assert outcome.code == 1
    assert outcome.out == ""
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"error: {reference}: has no pose within 0.1 s of a valid one of {recording}")
    assert "it covers 2020-09-13 12:26:40 to 2020-09-13 12:28:20" in line


def test_align_needs_a_reference(tsgt: Tsgt, recording: Path) -> None:
    """--align without --reference is a usage error."""
    outcome = tsgt("evaluate", recording, "--align", "rigid")
    assert outcome.code == 2
    assert "--align needs --reference" in outcome.err
