"""A mission with a reference point of the user's own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.analysis.evaluation import read_tum
from tsgt.cli.simulate import command
from tsgt.errors import TsgtError
from tsgt.estimation import parse_reference_point

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt

    from tsgt.config import ScenarioConfig

LIDAR = "lidar=0.8,-0.3,3.0,0.1,-0.2,0.3,0.9273618495495704"


@pytest.mark.slow
def test_every_output_is_of_the_point(tsgt: Tsgt, tmp_path: Path) -> None:
    """Stream, figures, truth and the figures of evo; invariants hold, a bit-exact replay among them."""
    recording, truth, live = tmp_path / "run.jsonl", tmp_path / "truth.tum", tmp_path / "live.tum"
    arguments = ("--duration", 25, "--point", LIDAR, "--output", recording, "--truth", truth, "--json")
    found = tsgt("simulate", "dynamic", *arguments)
    assert found.code == 0
    result = found.json()
    assert result["violations"] == 0
    assert result["reference_point"]["name"] == "lidar"
    assert "--point lidar=0.8,-0.3,3.0," in result["replay_command"]
    reference = read_tum(truth)
    assert reference.reference_point == parse_reference_point(LIDAR)
    assert tsgt("export", recording, "--kind", "smoothed", "--output", live).code == 0
    exported = read_tum(live)
    common, rows, true_rows = np.intersect1d(exported.stamp_ns, reference.stamp_ns, return_indices=True)
    inner = (common >= reference.stamp_ns[0] + 2 * 10**9) & (common <= reference.stamp_ns[-1] - 2 * 10**9)
    error_m = (exported.position_m[rows] - reference.position_m[true_rows])[inner]
    rms_mm = 1e3 * float(np.sqrt(np.mean(np.sum(error_m**2, axis=1))))
    smoothed = result["live"]["smoothed"]
    assert rms_mm == pytest.approx(smoothed["position_rms_mm"], abs=1e-3)
    assert smoothed["centroid"]["position_rms_mm"] < smoothed["position_rms_mm"] < 30
    evaluated = tsgt("evaluate", recording, "--no-held-out", "--reference", truth, "--json").json()
    assert evaluated["reference_point"] == result["reference_point"]
    # The truth's last digit is a nanometre.
    expected = result["estimators"]["continuous"]["position_rms_mm"]
    assert evaluated["position_rms_mm"] == pytest.approx(expected, abs=1e-4)


def test_point_of_the_robot_cannot_be_another(tsgt: Tsgt) -> None:
    """A usage error in one line."""
    outcome = tsgt("simulate", "--point", "robot=1,0,0", "--duration", 5)
    assert outcome.code == 2
    assert "robot is the robot frame itself; give another point another name" in outcome.err


def test_point_is_given_by_its_name(tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mission has the IMU of the scenario as its reference point."""
    points = []

    def record(scenario: ScenarioConfig, *_: object) -> None:
        points.append(scenario.reference_point.point())
        raise TsgtError("not run")

    monkeypatch.setattr(command, "_simulate", record)
    tsgt("simulate", "dynamic", "--imu", "industrial", "--point", "imu")
    assert [(point.name, point.position_m) for point in points] == [("imu", (0.21, -0.12, 0.43))]


def test_unknown_name_is_an_error(tsgt: Tsgt) -> None:
    """With the names that there are; this robot has no IMU."""
    outcome = tsgt("simulate", "--point", "imu", "--duration", 5)
    assert outcome.code == 2
    assert "--point: there is no point 'imu'; there are robot, centroid" in outcome.err
