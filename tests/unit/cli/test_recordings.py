"""Reading a recording with replaced parameters."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.records import IMU_PARAMETERS, PARAMETERS, measurement, recording_bytes

from tsgt.analysis.formats import write_imu_mounting, write_prism_layout, write_station_frames
from tsgt.cli.recordings import ImuOptions, load
from tsgt.estimation import centroid_point, named_point
from tsgt.model import ROBOT_ORIGIN, ReferencePoint, SetupCovariance
from tsgt.recording import encode_line

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.model import Parameters

LIDAR = ReferencePoint(name="lidar", position_m=(0.1, 0.2, 0.3))
WITH_IMU = replace(PARAMETERS, imu=IMU_PARAMETERS)
MOVED_IMU = replace(IMU_PARAMETERS, position_m=(0.4, 0.0, 0.5))


def recorded(path: Path, parameters: Parameters) -> Path:
    """Write a recording of a run with these parameters."""
    header = recording_bytes().splitlines(keepends=True)[0]
    path.write_bytes(header + b"".join(encode_line(each) + b"\n" for each in (parameters, measurement(0))))
    return path


def moved_layout(folder: Path) -> Path:
    """Write a layout 1 m further forwards."""
    positions_m = {each.prism: np.array(each.position_m) + np.eye(3)[0] for each in PARAMETERS.prisms}
    sigmas_m = dict.fromkeys(positions_m, np.full(3, 0.001))
    write_prism_layout(folder / "prisms.toml", positions_m, sigmas_m, comment="by a test")
    return folder / "prisms.toml"


def moved_imu(folder: Path) -> ImuOptions:
    """Write another mounting of the IMU."""
    covariance = SetupCovariance(components=("imu.x",), matrix=((1e-6,),))
    write_imu_mounting(folder / "imu.toml", MOVED_IMU, comment="by a test", covariance=covariance)
    return ImuOptions(setup=folder / "imu.toml")


@pytest.mark.parametrize("point", ["centroid", None])
def test_centroid_is_that_of_the_new_layout(tmp_path: Path, point: str | None) -> None:
    """Whether it is chosen or was recorded."""
    parameters = PARAMETERS if point else replace(PARAMETERS, reference_point=centroid_point(PARAMETERS))
    path = recorded(tmp_path / "r.jsonl", parameters)
    found = load(path, keep_going=False, prisms=moved_layout(tmp_path), point=point).parameters
    assert found.reference_point == centroid_point(found)
    assert found.reference_point.position_m[0] == pytest.approx(1.0)


@pytest.mark.parametrize("point", ["imu", None])
def test_point_of_the_imu_is_that_of_the_new_mounting(tmp_path: Path, point: str | None) -> None:
    """Whether it is chosen or was recorded."""
    parameters = WITH_IMU if point else replace(WITH_IMU, reference_point=IMU_PARAMETERS.point)
    path = recorded(tmp_path / "r.jsonl", parameters)
    found = load(path, keep_going=False, imu=moved_imu(tmp_path), point=point).parameters
    assert found.reference_point == MOVED_IMU.point


def test_imu_of_its_set_up_file_has_a_point(tmp_path: Path) -> None:
    """The master knew of none."""
    path = recorded(tmp_path / "r.jsonl", PARAMETERS)
    found = load(path, keep_going=False, imu=moved_imu(tmp_path), point="imu").parameters
    assert found.reference_point == MOVED_IMU.point


def test_other_points_stay_as_recorded(tmp_path: Path) -> None:
    """A place on the robot does not depend on the layout."""
    path = recorded(tmp_path / "r.jsonl", replace(PARAMETERS, reference_point=LIDAR))
    found = load(path, keep_going=False, prisms=moved_layout(tmp_path)).parameters
    assert found.reference_point == LIDAR


def test_parameters_without_prisms_have_points() -> None:
    """Of a master that was not calibrated: the origin, but no centroid."""
    uncalibrated = replace(PARAMETERS, prisms=(), no_poses="not calibrated")
    assert named_point(uncalibrated, "robot") == ROBOT_ORIGIN
    with pytest.raises(ValueError, match="there is no point 'centroid'; there are robot"):
        named_point(uncalibrated, "centroid")


def test_corrections_that_a_calibration_lacks_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of an earlier calibration may be among the recorded ones; a latency of its own replaces them."""
    frames, path = tmp_path / "frames.toml", tmp_path / "r.jsonl"
    first, *others = PARAMETERS.stations
    corrected = replace(first, latency_ns=30_000_000, atmospheric_ppm=200.0)
    recorded(path, replace(PARAMETERS, stations=(corrected, *others)))
    identity = {each.station: np.eye(4) for each in PARAMETERS.stations}
    write_station_frames(frames, identity, {}, comment="by a test")
    load(path, keep_going=False, frames=frames)
    said = capsys.readouterr().err
    assert "they stay as recorded: latency 30 ms of station 1, distance scale 200 ppm of station 1" in said
    write_station_frames(frames, identity, {}, comment="by a test", latencies_ms=dict.fromkeys(identity, 1.0))
    load(path, keep_going=False, frames=frames)
    assert "latency" not in capsys.readouterr().err
