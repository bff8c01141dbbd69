from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import START, driving, stationary_scene

from tsgt.analysis.evaluation import read_tum
from tsgt.analysis.formats import measurement_csv, pose_csv, tum_lines, valid_records, valid_rows
from tsgt.analysis.formats.export import MEASUREMENT_COLUMNS, POSE_COLUMNS
from tsgt.estimation import LinearEstimator
from tsgt.model import ROBOT_ORIGIN, PointMeasurement, ReferencePoint

if TYPE_CHECKING:
    from tsgt.estimation import PoseBatch

DOCUMENT = Path(__file__).parents[4] / "docs" / "reference" / "csv.md"


@pytest.fixture
def poses() -> PoseBatch:
    """Process some seconds of a driving robot; the first epochs are invalid."""
    scene = stationary_scene().moving(driving)
    pipeline = LinearEstimator(scene.parameters)
    for step in range(10):
        for station in (1, 2, 3):
            pipeline.add(scene.measure(station, 0.4 * step + 0.11 * station))
    return pipeline.advance(START + 3_900_000_000)


def test_tum_timestamps_are_exact() -> None:
    """Nine decimals of an integer, with leading zeros."""
    stamps = [1_647_269_269_000_000_001, 5, 1_647_269_269_950_000_000]
    rows = ((stamp, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) for stamp in stamps)
    _, _, *lines = tum_lines(rows, ROBOT_ORIGIN)
    assert [line.split()[0] for line in lines] == [
        "1647269269.000000001",
        "0.000000005",
        "1647269269.950000000",
    ]


def test_tum_contains_the_valid_poses(poses: PoseBatch) -> None:
    """One line of eight numbers per valid pose, to the nanometre."""
    rows = np.loadtxt(tum_lines(valid_rows(poses), ROBOT_ORIGIN))
    assert 0 < len(rows) < len(poses)
    np.testing.assert_allclose(rows[:, 1:4], poses.position_m[poses.valid], atol=1e-9)
    np.testing.assert_allclose(rows[:, 4:], poses.orientation_xyzw[poses.valid], atol=1e-12)


def test_tum_of_records_equals_tum_of_arrays(poses: PoseBatch) -> None:
    """Exporting recorded poses gives what processing gives, character by character."""
    of_records = tum_lines(valid_records(poses.records()), ROBOT_ORIGIN)
    assert list(of_records) == list(tum_lines(valid_rows(poses), ROBOT_ORIGIN))


def test_tum_states_its_point(tmp_path: Path) -> None:
    """In comments, one of which is read back."""
    lidar = ReferencePoint(name="lidar", position_m=(0.1, 0.2, 1 / 3), orientation_xyzw=(0.0, 0.0, 0.6, 0.8))
    rows = [(stamp, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)) for stamp in (1, 2)]
    lines = list(tum_lines(rows, lidar))
    assert lines[0] == "# lidar in station1: stamp_s x y z qx qy qz qw\n"
    (tmp_path / "poses.tum").write_text("".join(lines), encoding="utf-8")
    assert read_tum(tmp_path / "poses.tum").reference_point == lidar


def test_pose_csv_contains_all_poses(poses: PoseBatch) -> None:
    """Invalid poses with their reason and empty cells; numbers are read back exactly."""
    rows = list(csv.DictReader(pose_csv(poses.records())))
    assert [int(row["stamp_ns"]) for row in rows] == poses.stamp_ns.tolist()
    assert [row["valid"] == "1" for row in rows] == poses.valid.tolist()
    first, last = rows[0], next(row for row in reversed(rows) if row["valid"] == "1")
    assert (first["reason"], first["x_m"], first["sigma_rz_rad"], first["residual_m"]) == (
        "outage",
        "",
        "",
        "",
    )
    index = poses.stamp_ns.tolist().index(int(last["stamp_ns"]))
    assert [float(last[c]) for c in ("x_m", "y_m", "z_m")] == poses.position_m[index].tolist()
    assert float(last["sigma_ry_rad"]) == pytest.approx(np.sqrt(poses.covariance[index, 4, 4]))
    assert float(last["wz_radps"]) == poses.angular_velocity_radps[index, 2]


def test_measurement_csv_separates_polar_measurements_and_points() -> None:
    """A polar measurement has no position, a point no angles."""
    polar = stationary_scene().measure(2, 0.25)
    point = PointMeasurement(
        station=3, prism=3, sequence=7, stamp_ns=1, received_ns=2, position_m=(1.5, -2.0, 0.1)
    )
    first, second = csv.DictReader(measurement_csv([polar, point]))
    assert float(first["horizontal_angle_rad"]) == polar.horizontal_angle_rad
    assert float(first["slope_distance_m"]) == polar.slope_distance_m
    assert (first["type"], first["status"], first["x_m"]) == ("measurement", "ok", "")
    assert (second["type"], second["horizontal_angle_rad"]) == ("point", "")
    assert (second["sequence"], second["x_m"], second["y_m"], second["z_m"]) == ("7", "1.5", "-2.0", "0.1")


@pytest.mark.parametrize("columns", [POSE_COLUMNS, MEASUREMENT_COLUMNS])
def test_every_column_is_documented(columns: tuple[str, ...]) -> None:
    """Each column has its own row or its place in a row of docs/reference/csv.md."""
    text = DOCUMENT.read_text(encoding="utf-8")
    assert [column for column in columns if f"`{column}`" not in text] == []
