"""``tsgt analyse perturbation`` and ``layout``."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.analysis.design import inertial_study

if TYPE_CHECKING:
    from harness.files.cli import Tsgt

CONFIGS = Path(__file__).parents[4] / "configs"
SMALL = """kind = "prism_layout"
[prisms.1]
position_m = [-0.2, -0.15, 1.1]
[prisms.2]
position_m = [0.2, -0.15, 1.1]
[prisms.3]
position_m = [0.0, 0.2, 1.1]
"""
LINE = SMALL.replace("[0.0, 0.2, 1.1]", "[0.0, -0.15, 1.1]")
TWO = SMALL.split("[prisms.3]", maxsplit=1)[0]
FIGURES = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}
AXES = ("position_mean_mm", "position_std_mm", "euler_mean_rad", "euler_std_rad")


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Return a layout half as wide as that of the scenario."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


def test_perturbation_study_as_json(tsgt: Tsgt) -> None:
    """Noise from 0 to 400 mm in steps of 4; small noise agrees with first-order propagation."""
    study = tsgt("analyse", "perturbation", "--json").json()
    assert list(study["at_mm"]) == [str(4 * i) for i in range(101)]
    for found in study["at_mm"].values():
        assert {"position_norm_mean_mm", "rotation_norm_mean_rad", "inter_prism_mean_mm"} < set(found)
        assert all(len(found[key]) == 3 for key in AXES)
    few, per_mm = study["at_mm"]["8"], study["first_order_per_mm"]
    # 1000 samples determine a standard deviation to 2.2 %, one sigma.
    np.testing.assert_allclose(few["position_std_mm"], 8 * np.array(per_mm["position_std_mm"]), rtol=0.09)
    np.testing.assert_allclose(few["euler_std_rad"], 8 * np.array(per_mm["euler_std_rad"]), rtol=0.09)


def test_inter_prism_error_of_10_mm_against_the_paper(tsgt: Tsgt) -> None:
    """8 mm in position and 0.023 rad in rotation, 0.010 to 0.015 rad per axis; the paper states 10 mm and 0.01 rad."""
    found = tsgt("analyse", "perturbation", "--json").json()["equivalent"]
    assert found["inter_prism_mean_mm"] == pytest.approx(10)
    assert found["noise_mm"] == pytest.approx(8.86, abs=0.05)
    assert found["position_norm_mean_mm"] == pytest.approx(8.16, abs=0.05)
    assert found["rotation_norm_mean_rad"] == pytest.approx(0.0233, abs=0.0002)
    np.testing.assert_allclose(found["euler_abs_mean_rad"], [0.0150, 0.0100, 0.0097], atol=0.0002)


def test_perturbation_study_as_text(tsgt: Tsgt) -> None:
    """The text has a table, the equivalent noise, and the paper's figures."""
    outcome = tsgt(
        "analyse", "perturbation", "--noise-mm-max", 20, "--step-mm", 5, "--samples", 100, "--seed", 3
    )
    assert outcome.code == 0
    assert outcome.out.startswith("5 noise levels, 100 poses each")
    assert "A mean error of 10 mm between prisms corresponds to noise of 8.8" in outcome.out
    assert "The paper: 10 mm" in outcome.out
    assert "-0.0 " not in outcome.out


def test_layout_and_point_change_the_result(tsgt: Tsgt, small: Path) -> None:
    """A layout half as wide rotates more, and the origin, a metre below, moves with it."""
    arguments = ("analyse", "perturbation", "--noise-mm-max", 4, "--json")
    usual = tsgt(*arguments).json()
    found = tsgt(*arguments, "--prisms", small, "--point", "robot").json()
    assert found["prisms"]["3"] == [0.0, 0.2, 1.1]
    assert found["reference_point"]["position_m"] == [0, 0, 0]
    four, wide = found["at_mm"]["4"], usual["at_mm"]["4"]
    assert four["rotation_norm_mean_rad"] > 1.5 * wide["rotation_norm_mean_rad"]
    assert four["position_norm_mean_mm"] > 3 * wide["position_norm_mean_mm"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("--step-mm", 0),
        ("--samples", 1),
        ("--noise-mm-max", "nan"),
        ("--point", "nan,0,0"),
        ("--step-mm", 1e-3),
        ("--figure", "study.gif"),
        ("--figure", "/nowhere/study.png"),
        ("--prisms", "/nowhere.toml"),
    ],
)
def test_invalid_study_options_are_rejected(tsgt: Tsgt, arguments: tuple[object, ...]) -> None:
    """Exit code 2 and one line before any computation."""
    outcome = tsgt("analyse", "perturbation", *arguments)
    assert outcome.code == 2
    assert "rror: " in outcome.err


def test_collinear_prisms_are_rejected(tsgt: Tsgt, tmp_path: Path) -> None:
    """The error of both studies names file and prisms."""
    path = tmp_path / "line.toml"
    path.write_text(LINE)
    for arguments in (("perturbation", "--prisms", path), ("layout", path)):
        outcome = tsgt("analyse", *arguments)
        assert outcome.code == 2
        assert f"{path}: prisms: prisms 1, 2 and 3 lie nearly in a line" in outcome.err


def test_layouts_are_ranked(tsgt: Tsgt, small: Path) -> None:
    """The wider layout is first; its rotation sigma is about a third."""
    study = tsgt("analyse", "layout", small, "--json").json()
    assert study["ranking"] == ["dynamic", str(small)]
    wide, narrow = (study["layouts"][name] for name in study["ranking"])
    assert narrow["rotation_sigma_mrad"] > 1.5 * wide["rotation_sigma_mrad"]
    assert wide["worst_rotation_sigma_mrad"] >= wide["rotation_sigma_mrad"]
    lengths = math.hypot(*wide["position_axes_sigma_mm"])
    assert lengths == pytest.approx(wide["position_sigma_mm"])


def test_bytes_of_names_that_are_not_utf8_are_replaced(tsgt: Tsgt, small: Path) -> None:
    """They are drawn and printed; a system with Latin-1 has written such names."""
    named = small.rename(small.with_name(os.fsdecode(b"s\xe4.toml")))
    study = tsgt("analyse", "layout", named, "--json").json()
    assert study["ranking"] == ["dynamic", str(small.with_name("s\ufffd.toml"))]


def test_search_finds_a_better_layout_in_the_envelope(tsgt: Tsgt) -> None:
    """The result fills the box and is better than the scenario's layout in it."""
    box = (-0.5, 0.5, -0.4, 0.4, 1.0, 1.5)
    study = tsgt("analyse", "layout", "--envelope", *box, "--json").json()
    assert study["ranking"] == ["best in the envelope", "dynamic"]
    prisms = np.array(list(study["layouts"]["best in the envelope"]["prisms"].values()))
    assert prisms.min(axis=0).tolist() == [-0.5, -0.4, 1.0]
    assert prisms.max(axis=0).tolist() == [0.5, 0.4, 1.5]


def test_accuracy_decreases_with_distance(tsgt: Tsgt) -> None:
    """Angular noise grows with the distance in either arrangement of the stations."""
    study = tsgt("analyse", "layout", "--json").json()["stations_at_m"]
    assert list(study) == ["25", "50", "100", "200", "400"]
    for arrangement in ("together", "around"):
        sigmas = [found[arrangement]["rotation_sigma_mrad"] for found in study.values()]
        assert sigmas == sorted(sigmas)


def test_layouts_as_text(tsgt: Tsgt, small: Path) -> None:
    """The text has the ranking, the best layout in TOML, and other station positions."""
    outcome = tsgt(
        "analyse",
        "layout",
        small,
        "--scenario",
        "quarry",
        "--objective",
        "position",
        "--envelope",
        *[-1, 1] * 3,
    )
    assert outcome.code == 0
    ranked = [line.split()[0] for line in outcome.out.splitlines()[4:6]]
    assert ranked[0] == "best"
    assert "  [prisms.1]\n  position_m = [" in outcome.out
    assert "Other station positions, with best in the envelope" in outcome.out


def test_configuration_needs_an_area(tsgt: Tsgt) -> None:
    """A configuration has stations and prisms, but no area of the drive."""
    config = CONFIGS / "master.example.toml"
    study = tsgt("analyse", "layout", "--config", config, "--area", 30, 10, 0, 20, "--json").json()
    assert study["ranking"] == [str(config)]
    assert tsgt("analyse", "layout", "--config", config).code == 2


def test_two_stations_and_an_imu_have_a_table(tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the first station alone and of both; there is nothing to rank."""
    monkeypatch.setattr(inertial_study, "MAX_DURATION_S", 60.0)
    arguments = ("--config", CONFIGS / "master.two-stations.example.toml", "--area", 60, 45, -1, 40)
    found = tsgt("analyse", "layout", *arguments, "--json").json()["with_imu"]
    assert found.keys() == {"1", "2"}
    assert (
        0.7 < found["2"]["smoothed"]["position_sigma_mm"] < found["1"]["smoothed"]["position_sigma_mm"] < 3.0
    )
    outcome = tsgt("analyse", "layout", *arguments, "--envelope", 0, 1, 0, 1, 0, 1)
    assert (outcome.code, "--envelope and --figure need 3 tracked prisms" in outcome.err) == (2, True)


def test_class_of_the_imu_adds_a_table(tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the ranking; a route is driven along."""
    monkeypatch.setattr(inertial_study, "MAX_DURATION_S", 60.0)
    outcome = tsgt("analyse", "layout", "--scenario", "ski-trail", "--imu", "consumer")
    rows = [line.split() for line in outcome.out.splitlines()[-3:]]
    assert [row[0] for row in rows] == ["1", "2", "3"]
    yaw = [float(row[3]) for row in rows]
    assert yaw[0] > yaw[1] > yaw[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--envelope", 1, 0, 0, 1, 0, 1), "a minimum is above its maximum"),
        (("--envelope", "nan", 0, 0, 1, 0, 1), "finite"),
        (("--area", 0, 0, 0, -1), "radius is below zero"),
        (("--scenario", "nowhere"), "no such scenario"),
        (("--scenario", "dynamic", "--config", "master.toml"), "exclude each other"),
    ],
)
def test_invalid_layout_options_are_rejected(tsgt: Tsgt, arguments: tuple[object, ...], message: str) -> None:
    """Exit code 2 and one line that says what to correct."""
    outcome = tsgt("analyse", "layout", *arguments)
    assert outcome.code == 2
    assert message in outcome.err


def test_envelope_without_a_valid_layout_fails(tsgt: Tsgt) -> None:
    """Exit code 1: no layout in the box keeps the minimum separation."""
    outcome = tsgt("analyse", "layout", "--envelope", 0, 0.1, 0, 0.1, 1, 1.1)
    assert outcome.code == 1
    assert "no room for 3 prisms" in outcome.err


def test_layout_without_a_tracked_prism_is_rejected(tsgt: Tsgt, tmp_path: Path) -> None:
    """Each tracked prism needs a position."""
    path = tmp_path / "four.toml"
    path.write_text(SMALL.replace("[prisms.3]", "[prisms.4]"))
    outcome = tsgt("analyse", "layout", path)
    assert outcome.code == 2
    assert f"{path}: prisms.3: missing; a station tracks it" in outcome.err


@pytest.mark.slow
@pytest.mark.parametrize("ending", FIGURES)
@pytest.mark.parametrize("study", ["perturbation", "layout"])
def test_figures_are_drawn(tsgt: Tsgt, tmp_path: Path, study: str, ending: str) -> None:
    """The suffix selects the format."""
    path = tmp_path / f"study{ending}"
    arguments = ("analyse", study, "--figure", path, *(("--samples", 10) if study == "perturbation" else ()))
    assert tsgt(*arguments).code == 0
    assert path.read_bytes().startswith(FIGURES[ending])


def test_figure_without_matplotlib_fails_before_the_study(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says what to install; the studies themselves do not need matplotlib."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    path = tmp_path / "study.png"
    outcome = tsgt("analyse", "layout", "--figure", path)
    assert outcome.code == 1
    assert "pip install 'tsgt[report]'" in outcome.err
    assert not path.exists()
    assert tsgt("analyse", "layout").code == 0
