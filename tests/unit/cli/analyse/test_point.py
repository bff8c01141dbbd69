"""The reference point of the studies: given as for every other command, and named with every position."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tsgt.analysis import figures
from tsgt.analysis.design import inertial_study

if TYPE_CHECKING:
    from harness.files.cli import Tsgt

    from tsgt.model import ReferencePoint

CONFIG = Path(__file__).parents[4] / "configs" / "master.example.toml"
PRISMS = "".join(
    f"[prisms.{number}]\nposition_m = {place}\n"
    for number, place in enumerate(([0.7, -0.3, 1.0], [0.3, -0.3, 1.0], [0.5, 0.3, 1.3]), start=4)
)
STUDIES: dict[str, tuple[object, ...]] = {
    "layout": (),
    "perturbation": ("--noise-mm-max", 4, "--samples", 10),
}


def test_centroid_is_that_of_the_given_layout(tsgt: Tsgt, tmp_path: Path) -> None:
    """By name as by default, whatever the numbers of the prisms."""
    path = tmp_path / "layout.toml"
    path.write_text(f'kind = "prism_layout"\n{PRISMS}')
    arguments = ("analyse", "perturbation", *STUDIES["perturbation"], "--prisms", path, "--json")
    default = tsgt(*arguments).json()
    assert default["reference_point"]["name"] == "centroid"
    np.testing.assert_allclose(default["reference_point"]["position_m"], [0.5, -0.1, 1.1], atol=1e-12)
    assert tsgt(*arguments, "--point", "centroid").json() == default


@pytest.mark.parametrize("study", STUDIES)
def test_table_and_figure_name_the_point(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, study: str
) -> None:
    """With its place, of which a name alone tells nothing."""
    drawn: list[ReferencePoint] = []

    def draw(_first: Any, _second: Any, point: ReferencePoint, *_path: Any) -> None:
        drawn.append(point)

    monkeypatch.setattr(figures, "draw_layouts", draw)
    monkeypatch.setattr(figures, "draw_perturbation", draw)
    arguments = ("--point", "lidar=0.25,0,0.62", "--figure", tmp_path / "a.png")
    out = tsgt("analyse", study, *STUDIES[study], *arguments).out
    assert "position" in out
    assert "lidar at (0.25, 0, 0.62) m" in out
    assert [point.name for point in drawn] == ["lidar"]
    assert "the robot's origin" in tsgt("analyse", study, *STUDIES[study], "--point", "robot").out


@pytest.mark.parametrize("study", STUDIES)
@pytest.mark.parametrize(
    ("point", "message"),
    [
        ("lidar", "--point: there is no point 'lidar'; there are robot, centroid"),
        ("imu", "--point: there is no point 'imu'; there are robot, centroid"),
        ("0,0", "expected X,Y,Z or NAME=X,Y,Z[,QX,QY,QZ,QW] in m"),
        ("robot=1,0,0", "robot is the robot frame itself"),
    ],
)
def test_errors_are_those_of_every_command(tsgt: Tsgt, study: str, point: str, message: str) -> None:
    """A usage error with what to give instead; the robot has no IMU here."""
    outcome = tsgt("analyse", study, *STUDIES[study], "--point", point)
    assert (outcome.code, message in outcome.err) == (2, True), outcome.err


def test_layout_has_the_point_of_the_configuration(tsgt: Tsgt, tmp_path: Path) -> None:
    """The default is the point whose pose the master streams, and its name stands for it."""
    for name in ("station_frames", "prism_layout"):
        (tmp_path / f"{name}.example.toml").write_text(
            (CONFIG.parent / f"{name}.example.toml").read_text(encoding="utf-8")
        )
    config = tmp_path / "master.toml"
    example = CONFIG.read_text(encoding="utf-8").replace('name = "robot"', 'name = "lidar"')
    config.write_text(example.replace("position_m = [0.0, 0.0, 0.0]", "position_m = [0.25, 0.0, 0.62]"))
    arguments = ("analyse", "layout", "--config", config, "--area", 30, 10, 0, 20, "--json")
    found = tsgt(*arguments).json()
    assert found["reference_point"]["name"] == "lidar"
    assert found["reference_point"]["position_m"] == [0.25, 0, 0.62]
    assert tsgt(*arguments, "--point", "lidar").json() == found
    assert tsgt(*arguments, "--point", "robot").json()["layouts"] != found["layouts"]


def test_layout_knows_the_imu_of_the_scenario(tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch) -> None:
    """At its place on the robot, with a unit quaternion."""
    monkeypatch.setattr(inertial_study, "MAX_DURATION_S", 30.0)
    found = tsgt("analyse", "layout", "--imu", "industrial", "--point", "imu", "--json").json()
    assert found["reference_point"]["name"] == "imu"
    assert found["reference_point"]["position_m"] == [0.21, -0.12, 0.43]
    assert math.hypot(*found["reference_point"]["orientation_xyzw"]) == pytest.approx(1, abs=1e-12)
