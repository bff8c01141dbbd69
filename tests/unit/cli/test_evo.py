"""Agreement of ``evo`` with ``tsgt evaluate --reference``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.authors_files import write_prisms, write_tracks
from harness.scene import LAYOUT

if TYPE_CHECKING:
    from pathlib import Path

    from harness.cli import Tsgt


@pytest.mark.parametrize("estimator", ["linear", "continuous"])
def test_evo_agrees_with_evaluate(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, estimator: str
) -> None:
    """To 1e-6 m and 1e-6 degrees, unaligned, at the prisms' centroid, without 2 s at both ends of the reference."""
    monkeypatch.setenv("HOME", str(tmp_path))  # evo writes its settings there when it is first imported
    metrics = pytest.importorskip("evo.core.metrics")
    sync = pytest.importorskip("evo.core.sync")
    read = pytest.importorskip("evo.tools.file_interface").read_tum_trajectory_file
    recording, files = tmp_path / "drive.jsonl", {}
    tracks, prisms = write_tracks(tmp_path), write_prisms(tmp_path)
    assert tsgt("import", "rts", "--tracks", *tracks, "--prisms", prisms, "--output", recording).code == 0
    for name in ("linear", "continuous"):
        poses, files[name] = tmp_path / f"{name}.jsonl", tmp_path / f"{name}.tum"
        assert tsgt("process", recording, "--estimator", name, "--output", poses).code == 0
        assert tsgt("export", poses, "--format", "tum", "--output", files[name]).code == 0
    other = files["continuous" if estimator == "linear" else "linear"]
    arguments = ["--estimator", estimator, "--reference", other, "--no-held-out", "--json"]
    ours = tsgt("evaluate", recording, *arguments).json()

    to_centroid = np.eye(4)
    to_centroid[:3, 3] = LAYOUT.mean(axis=0)
    reference, poses_of_evo = read(str(other)), read(str(files[estimator]))
    poses_of_evo.reduce_to_time_range(reference.timestamps[0] + 2.0, reference.timestamps[-1] - 2.0)
    for trajectory in (reference, poses_of_evo):
        trajectory.transform(to_centroid, right_mul=True)
    pair = sync.associate_trajectories(reference, poses_of_evo, max_diff=1e-6)

    def rms(relation: Any) -> float:
        ape = metrics.APE(relation)
        ape.process_data(pair)
        return float(ape.get_statistic(metrics.StatisticsType.rmse))

    assert pair[0].num_poses == ours["compared"] > 100
    assert ours["position_rms_mm"] > 0.5
    relation = metrics.PoseRelation
    assert rms(relation.translation_part) == pytest.approx(ours["position_rms_mm"] / 1e3, abs=1e-6)
    assert rms(relation.rotation_angle_deg) == pytest.approx(ours["orientation_rms_deg"], abs=1e-6)
