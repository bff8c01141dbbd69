"""Reference poses from recordings, TUM and CSV files: what each of them keeps of the poses."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import START, driving, stationary_scene
from harness.files.pose_files import Poses, write_tum
from harness.files.records import recording_bytes

from tsgt.analysis.formats import pose_csv, tum_lines, valid_rows
from tsgt.analysis.formats.trajectories import (
    is_measured,
    is_recording,
    read_reference_poses,
    reference_of_poses,
)
from tsgt.errors import InputFileError, TsgtError
from tsgt.estimation import LinearEstimator, poses_at
from tsgt.geometry import rotation_from_quaternion
from tsgt.model import ROBOT_ORIGIN, ReferencePoint

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.estimation import PoseBatch

LIDAR = ReferencePoint(name="lidar", position_m=(0.1, 0.2, 0.3))


@pytest.fixture(scope="module")
def poses() -> PoseBatch:
    """Process some seconds of a driving robot; the first epochs are invalid."""
    scene = stationary_scene().moving(driving)
    pipeline = LinearEstimator(scene.parameters)
    for step in range(10):
        for station in (1, 2, 3):
            pipeline.add(scene.measure(station, 0.4 * step + 0.11 * station))
    return pipeline.advance(START + 3_900_000_000)


def test_poses_of_a_recording(poses: PoseBatch) -> None:
    """Matrices of the valid poses, and their covariances; invalid ones remain, marked."""
    found = reference_of_poses(poses)
    np.testing.assert_array_equal(found.stamp_ns, poses.stamp_ns)
    np.testing.assert_array_equal(found.valid, poses.valid)
    valid = poses.valid
    assert 0 < valid.sum() < len(valid)
    np.testing.assert_array_equal(found.T_station1_point[valid, :3, 3], poses.position_m[valid])
    rotation = rotation_from_quaternion(poses.orientation_xyzw[valid])
    np.testing.assert_array_equal(found.T_station1_point[valid, :3, :3], rotation)
    np.testing.assert_array_equal(found.T_station1_point[~valid][0], np.eye(4))
    assert found.covariance is not None
    np.testing.assert_array_equal(found.covariance[valid], poses.covariance[valid])


def test_recorded_poses_equal_computed_ones(tmp_path: Path, poses: PoseBatch) -> None:
    """What tsgt process writes has no measurements; reading it gives the same bits."""
    parameters = stationary_scene().parameters
    path = tmp_path / "poses.jsonl"
    path.write_bytes(recording_bytes(parameters, *poses.records()))
    assert is_recording(path)
    assert not is_measured(path)
    found, computed = read_reference_poses(path), reference_of_poses(poses)
    np.testing.assert_array_equal(found.stamp_ns, computed.stamp_ns)
    np.testing.assert_array_equal(found.valid, computed.valid)
    np.testing.assert_array_equal(found.T_station1_point, computed.T_station1_point)
    assert found.covariance is not None
    assert computed.covariance is not None
    np.testing.assert_array_equal(found.covariance[found.valid], computed.covariance[found.valid])
    assert found.point == ROBOT_ORIGIN


def test_joined_runs_with_different_set_ups_are_refused(tmp_path: Path, poses: PoseBatch) -> None:
    """Their poses are in different frames, which no comparison shows."""
    parameters = stationary_scene().parameters
    first, *others = parameters.prisms
    moved = replace(first, position_m=(0.0, 0.0, 9.0))
    path = tmp_path / "poses.jsonl"
    path.write_bytes(
        recording_bytes(parameters, *poses.select(slice(0, 20)).records())
        + recording_bytes(
            replace(parameters, prisms=(moved, *others)), *poses.select(slice(20, None)).records()
        )
    )
    with pytest.raises(InputFileError, match=r"line \d+: its set-up is not that of the pose before"):
        read_reference_poses(path)


def test_measured_recording_is_told(tmp_path: Path) -> None:
    """Its poses are computed, not read."""
    scene = stationary_scene()
    path = tmp_path / "recording.jsonl"
    path.write_bytes(recording_bytes(scene.parameters, scene.measure(1, 0.1)))
    assert is_measured(path)
    assert not is_recording(write_tum(tmp_path / "a.tum", Poses(3)))


def test_tum_keeps_its_point(tmp_path: Path, poses: PoseBatch) -> None:
    """The comment states it; without, it is the robot's origin. There is no covariance."""
    path = tmp_path / "a.tum"
    path.write_text("".join(tum_lines(valid_rows(poses_at(poses, LIDAR)), LIDAR)))
    assert read_reference_poses(path).point == LIDAR
    plain = write_tum(tmp_path / "b.tum", Poses(3))
    found = read_reference_poses(plain)
    assert found.point == ROBOT_ORIGIN
    assert found.covariance is None
    np.testing.assert_array_equal(found.stamp_ns, Poses(3).stamp_ns)


def test_csv_keeps_sigmas_and_invalid_poses(tmp_path: Path, poses: PoseBatch) -> None:
    """As tsgt export writes it."""
    path = tmp_path / "a.csv"
    path.write_text("".join(pose_csv(poses.records())))
    found = read_reference_poses(path)
    np.testing.assert_array_equal(found.stamp_ns, poses.stamp_ns)
    np.testing.assert_array_equal(found.valid, poses.valid)
    assert found.covariance is not None
    valid = poses.valid
    np.testing.assert_array_equal(found.T_station1_point[valid, :3, 3], poses.position_m[valid])
    diagonal = np.diagonal(poses.covariance[valid], axis1=1, axis2=2)
    np.testing.assert_allclose(found.covariance[valid], np.eye(6) * diagonal[:, None, :])


def test_csv_of_another_point_is_refused(tmp_path: Path, poses: PoseBatch) -> None:
    """The file names it, but does not say where it is."""
    path = tmp_path / "a.csv"
    path.write_text("".join(pose_csv(poses_at(poses, LIDAR).records())))
    with pytest.raises(InputFileError, match="has poses of lidar, but not where that is on the robot"):
        read_reference_poses(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x,y,z\n1,2,3,4\n2,3,4,5\n", "has positions alone"),
        (
            "t,x,y,z,qx,qy,qz,qw\n2,2,3,4,0,0,0,1\n1,3,4,5,0,0,0,1\n",
            "cannot be the reference: times ran backwards",
        ),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n", "line 2: has 7 columns"),
        ('{"type":"hello"}\n', "recording"),
    ],
)
def test_refused(tmp_path: Path, text: str, message: str) -> None:
    """The reference is not repaired."""
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(TsgtError, match=message):
        read_reference_poses(path)
