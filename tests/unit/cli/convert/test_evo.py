"""Agreement of ``evo`` on exported files with ``tsgt evaluate --reference``: to 1e-6 m and 1e-6 degrees, unaligned."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from harness.files.authors_files import write_prisms, write_tracks

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from harness.files.cli import Tsgt

LIDAR = "lidar=0.8,-0.3,-1.2,0.1,-0.2,0.3,0.9273618495495704"


@pytest.fixture
def recording(tsgt: Tsgt, tmp_path: Path) -> Path:
    """Ten seconds of driving, as points."""
    path = tmp_path / "drive.jsonl"
    sources = ("--tracks", *write_tracks(tmp_path), "--prisms", write_prisms(tmp_path))
    assert tsgt("import", "rts", *sources, "--output", path).code == 0
    return path


@pytest.fixture
def evo_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Path, Path], tuple[int, float, float, float]]:
    """Return what evo says of a reference and a file, without 2 s at both ends.

    Number of poses, APE (rms) in m and in degrees, RPE (rms) in m over all pairs that are 1 m apart.
    """
    monkeypatch.setenv("HOME", str(tmp_path))  # evo writes its settings there when it is first imported
    metrics = pytest.importorskip("evo.core.metrics")
    sync = pytest.importorskip("evo.core.sync")
    read = pytest.importorskip("evo.tools.file_interface").read_tum_trajectory_file

    def errors(reference_path: Path, path: Path) -> tuple[int, float, float, float]:
        reference, found = read(str(reference_path)), read(str(path))
        found.reduce_to_time_range(reference.timestamps[0] + 2.0, reference.timestamps[-1] - 2.0)
        pair = sync.associate_trajectories(reference, found, max_diff=1e-6)

        def rms(metric: Any) -> float:
            metric.process_data(pair)
            return float(metric.get_statistic(metrics.StatisticsType.rmse))

        relation = metrics.PoseRelation
        rpe = metrics.RPE(
            relation.translation_part, delta=1.0, delta_unit=metrics.Unit.meters, all_pairs=True
        )
        ape = (metrics.APE(each) for each in (relation.translation_part, relation.rotation_angle_deg))
        return pair[0].num_poses, *map(rms, ape), rms(rpe)

    return errors


@pytest.mark.parametrize("point", ["0,0,0", LIDAR], ids=["origin", "point"])
@pytest.mark.parametrize("estimator", ["linear", "continuous"])
def test_evo_agrees_with_evaluate(
    tsgt: Tsgt,
    recording: Path,
    evo_errors: Callable[[Path, Path], tuple[int, float, float, float]],
    estimator: str,
    point: str,
) -> None:
    """At the robot's origin and at a point of the user's own, with its own axes; the reference file states its point."""
    files = {name: recording.with_name(f"{name}.tum") for name in ("linear", "continuous")}
    for name, path in files.items():
        poses = recording.with_name(f"{name}.jsonl")
        assert tsgt("process", recording, "--estimator", name, "--output", poses).code == 0
        assert tsgt("export", poses, "--point", point, "--output", path).code == 0
    other = files["continuous" if estimator == "linear" else "linear"]
    arguments = ["--estimator", estimator, "--reference", other, "--no-held-out", "--json", "--point", point]
    ours = tsgt("evaluate", recording, *arguments).json()
    compared, position_m, rotation_deg, relative_m = evo_errors(other, files[estimator])
    assert compared == ours["compared"] > 100
    assert ours["position_rms_mm"] > 0.5
    assert ours["position_rms_mm"] != pytest.approx(ours["centroid"]["position_rms_mm"], abs=0.05)
    assert position_m == pytest.approx(ours["position_rms_mm"] / 1e3, abs=1e-6)
    assert rotation_deg == pytest.approx(ours["orientation_rms_deg"], abs=1e-6)
    assert ours["ate"]["position_rms_mm"] == pytest.approx(ours["position_rms_mm"], abs=1e-9)
    (over_1_m,) = [
        each for each in ours["rpe"] if (each["delta"], each["unit"], each["pairs"]) == (1.0, "m", "all")
    ]
    assert relative_m == pytest.approx(over_1_m["position_rms_mm"] / 1e3, abs=1e-6)


def test_relative_errors_are_printed(tsgt: Tsgt, recording: Path) -> None:
    """A table of RPE over metres and a second."""
    reference = recording.with_name("reference.tum")
    assert tsgt("process", recording, "--output", reference).code == 0
    printed = tsgt("evaluate", recording, "--reference", reference, "--no-held-out").out
    assert "Relative pose errors (RPE)" in printed
    assert "1 m, one after the other" in printed


def test_reference_of_the_robot_is_carried_over(
    tsgt: Tsgt, recording: Path, evo_errors: Callable[[Path, Path], tuple[int, float, float, float]]
) -> None:
    """A reference of the robot's origin and poses of another point are compared at the latter, as both files there are."""
    plain, at_point, found = (recording.with_name(f"{name}.tum") for name in ("plain", "at_point", "found"))
    assert tsgt("process", recording, "--estimator", "linear", "--output", plain).code == 0
    assert (
        tsgt("process", recording, "--estimator", "linear", "--point", LIDAR, "--output", at_point).code == 0
    )
    assert tsgt("process", recording, "--point", LIDAR, "--output", found).code == 0
    arguments = ["--no-held-out", "--json", "--point", LIDAR, "--reference"]
    ours = tsgt("evaluate", recording, *arguments, plain).json()
    _, position_m, rotation_deg, _ = evo_errors(at_point, found)
    assert position_m == pytest.approx(ours["position_rms_mm"] / 1e3, abs=1e-6)
    assert rotation_deg == pytest.approx(ours["orientation_rms_deg"], abs=1e-6)


@pytest.mark.slow
def test_point_of_a_reference_without_comments_can_be_given(tsgt: Tsgt, recording: Path) -> None:
    """As of a trajectory that another program wrote for its sensor."""
    stated, bare = recording.with_name("stated.tum"), recording.with_name("bare.tum")
    assert tsgt("process", recording, "--estimator", "linear", "--point", LIDAR, "--output", stated).code == 0
    lines = stated.read_text(encoding="utf-8").splitlines(keepends=True)
    bare.write_text("".join(line for line in lines if not line.startswith("#")), encoding="utf-8")
    arguments = ("evaluate", recording, "--no-held-out", "--json", "--reference")
    expected = tsgt(*arguments, stated).json()
    found = tsgt(*arguments, bare, "--reference-point", LIDAR).json()
    wrong = tsgt(*arguments, bare).json()
    assert found["position_rms_mm"] == expected["position_rms_mm"] < 100
    assert wrong["position_rms_mm"] > 1000
