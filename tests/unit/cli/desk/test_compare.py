"""``tsgt compare`` on files of poses: what it prints, writes and refuses."""

from __future__ import annotations

import csv
import json
import runpy
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.drives.paired import drive, noisy
from harness.files.cli import called
from scipy.spatial.transform import Rotation

from tsgt.config import SensorMountingFile, load
from tsgt.geometry import invert, quaternion_from_rotation, transform_from

if TYPE_CHECKING:
    from harness.files.cli import Tsgt

EXAMPLE = Path(__file__).parents[4] / "examples" / "compare_estimates.py"

START_S = 1_780_000_000
RATE_HZ = 10.0
COUNT = 500
OFFSET_S = 0.25
EXTRINSIC = transform_from(Rotation.from_euler("z", 0.4).as_matrix(), np.array([0.35, 0.1, 0.6]))
FRAME = transform_from(Rotation.from_euler("z", -1.1).as_matrix(), np.array([12.0, -4.0, 1.0]))
TRUE = drive(COUNT, RATE_HZ, speed_mps=1.5)
NOISE_M = 0.005


def write_tum(path: Path, poses: np.ndarray, *, offset_s: float = 0.0) -> Path:
    """Write poses, (N, 4, 4), at 10 Hz."""
    stamps_ns = START_S * 10**9 + np.arange(len(poses)) * 100_000_000 - round(offset_s * 1e9)
    rows = np.hstack([poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3])])
    path.write_text(
        "".join(
            f"{stamp // 10**9}.{stamp % 10**9:09d} {' '.join(f'{value:.12g}' for value in row)}\n"
            for stamp, row in zip(stamps_ns.tolist(), rows.tolist(), strict=True)
        )
    )
    return path


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return poses of the robot's origin."""
    return write_tum(tmp_path_factory.mktemp("reference") / "reference.tum", TRUE)


@pytest.fixture(scope="module")
def lidar(reference: Path) -> Path:
    """Return an estimate with another clock, frame and point on the robot, and a little noise."""
    sensor = noisy(TRUE @ EXTRINSIC, np.random.default_rng(2), position_m=NOISE_M, rotation_rad=0.001)
    return write_tum(reference.with_name("lidar.tum"), invert(FRAME) @ sensor, offset_s=OFFSET_S)


@pytest.fixture(scope="module")
def fitted(reference: Path, lidar: Path) -> dict[str, Any]:
    """Return the figures with everything fair fitted; the files errors.csv and lidar.toml stand beside the reference."""
    outcome = called(
        *("compare", reference, lidar, "--fit", "offset,extrinsic", "--json"),
        *("--output", reference.with_name("lidar.toml"), "--csv", reference.with_name("errors.csv")),
    )
    assert outcome.code == 0
    found: dict[str, Any] = outcome.json()
    return found


def test_offset_and_extrinsic_are_found(fitted: dict[str, Any]) -> None:
    """The keys of the contract; what remains is the noise."""
    assert set(fitted) == {"reference", "estimates"}
    each: dict[str, Any] = fitted["estimates"]["lidar"]
    assert each["offset_ms"] == pytest.approx(1e3 * OFFSET_S, abs=max(1.0, 3 * each["offset_sigma_ms"]))
    assert np.array(each["extrinsic"])[:2, 3] == pytest.approx(EXTRINSIC[:2, 3], abs=0.01)
    assert each["ate"]["position_rms_mm"] == pytest.approx(1e3 * NOISE_M * 3**0.5, rel=0.3)
    assert each["ate"]["explained_position_rms_mm"] is None  # TUM has no covariance
    assert each["completeness"]["share"] > 0.98
    assert each["nees"] is None
    assert {r["delta"] for r in each["rpe"]} >= {1.0, 10.0}
    assert each["aligned"]["position_rms_mm"] <= each["ate"]["position_rms_mm"] + 1.0
    assert "extrinsic" in each["smallest_fair_set"]["fit"]
    assert all(step["fair"] for step in each["steps"][:-1])


def test_default_fits_the_clock_and_the_start_alone(tsgt: Tsgt, reference: Path, lidar: Path) -> None:
    """It says that the extrinsic is missing, what with it the error is, and stays with the honest figure."""
    outcome = tsgt("compare", reference, lidar)
    assert outcome.code == 0
    assert "smallest fair set" in outcome.out
    assert "use --fit offset,extrinsic, or --extrinsic FILE" in outcome.err
    rows = {
        line[:36].strip(): line[36:].split()
        for line in outcome.out.splitlines()
        if line.startswith(("ATE", "every", "ext"))
    }
    assert rows["extrinsic x (mm)"] == ["0.0", "fixed"]
    assert float(rows["ATE position, rms (mm)"][0]) > 100.0
    assert float(rows["everything aligned: position (mm)"][0]) < 20.0


def test_nothing_fitted_is_what_evo_says(
    tsgt: Tsgt, reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ATE and RPE of poses on the same clock, in the same frame, of the same point; to 1e-9 m."""
    monkeypatch.setenv("HOME", str(tmp_path))
    metrics = pytest.importorskip("evo.core.metrics")
    sync = pytest.importorskip("evo.core.sync")
    read = pytest.importorskip("evo.tools.file_interface").read_tum_trajectory_file
    found = write_tum(
        tmp_path / "found.tum",
        noisy(TRUE, np.random.default_rng(2), position_m=0.02, rotation_rad=0.002)[: COUNT // 2],
    )
    each = tsgt("compare", reference, found, "--fit", "none", "--align", "none", "--json").json()
    each = each["estimates"]["found"]
    pair = sync.associate_trajectories(read(str(reference)), read(str(found)), max_diff=1e-6)
    for relation, key, scale in (
        (metrics.PoseRelation.translation_part, "position_rms_mm", 1e3),
        (metrics.PoseRelation.rotation_angle_deg, "orientation_rms_deg", 1.0),
    ):
        metric = metrics.APE(relation)
        metric.process_data(pair)
        assert each["ate"][key] / scale == pytest.approx(
            metric.get_statistic(metrics.StatisticsType.rmse), abs=1e-9
        )
    assert each["offset_ms"] == 0.0


def test_mounting_is_written_and_used_again(
    tsgt: Tsgt, reference: Path, lidar: Path, fitted: dict[str, Any]
) -> None:
    """With the file, the default has the error that the fit had."""
    mounting = reference.with_name("lidar.toml")
    assert tsgt("config", "check", mounting).code == 0
    held = tsgt("compare", reference, lidar, "--json", "--extrinsic", mounting).json()["estimates"]["lidar"]
    each = fitted["estimates"]["lidar"]
    assert held["fit"] == ["frame", "offset"]
    assert held["align"] == "start"
    assert np.array(held["extrinsic"]) == pytest.approx(np.array(each["extrinsic"]), abs=1e-6)
    assert held["ate"]["position_rms_mm"] == pytest.approx(each["ate"]["position_rms_mm"], rel=0.05)


def test_written_mounting_keeps_what_was_known(
    tsgt: Tsgt, reference: Path, lidar: Path, fitted: dict[str, Any], tmp_path: Path
) -> None:
    """A position that the given file holds exactly was not fitted, and is as exact afterwards."""
    del fitted
    given, written = tmp_path / "given.toml", tmp_path / "written.toml"
    lines = reference.with_name("lidar.toml").read_text().splitlines(keepends=True)
    first = next(row for row, line in enumerate(lines) if line.startswith("position_sigma_mm"))
    given.write_text(
        "".join(lines[:first]) + "position_sigma_mm = [0.0, 0.0, 0.0]\n" + "".join(lines[first + 5 :])
    )
    for parts in ("offset,extrinsic", "offset"):
        outcome = tsgt("compare", reference, lidar, "--extrinsic", given, "--fit", parts, "--output", written)
        assert outcome.code == 0, outcome.err
        mounting = load(written, SensorMountingFile)
        assert mounting.position_sigma_mm == (0.0, 0.0, 0.0)
        assert mounting.rotation_sigma_deg is not None
        assert max(mounting.rotation_sigma_deg) < 1.0


def test_offset_of_relative_times_is_not_written(
    tsgt: Tsgt, reference: Path, lidar: Path, tmp_path: Path
) -> None:
    """It would say nothing of another drive, and no file could hold it."""
    relative, written = tmp_path / "relative.tum", tmp_path / "relative.toml"
    lines = [line.split() for line in lidar.read_text().splitlines()]
    relative.write_text(
        "".join(f"{float(time) - START_S + 1.0:.9f} {' '.join(rest)}\n" for time, *rest in lines)
    )
    options = ("--fit", "offset,extrinsic", "--output", written)
    assert tsgt("compare", reference, relative, *options).code == 0
    assert "offset_ms" not in written.read_text()
    assert tsgt("compare", reference, relative, "--extrinsic", written).code == 0


def test_errors_are_written_as_csv(reference: Path, fitted: dict[str, Any]) -> None:
    """One line for each compared pose."""
    with reference.with_name("errors.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    ate = fitted["estimates"]["lidar"]["ate"]
    assert len(rows) == ate["n"]
    squares = [float(row["position_error_m"]) ** 2 for row in rows if row["estimate"] == "lidar"]
    assert 1e3 * np.sqrt(np.mean(squares)) == pytest.approx(ate["position_rms_mm"], rel=1e-4)
    assert rows[0]["reference_sigma_along_m"] == ""
    # To the last bit: seven digits are millimetres beyond a kilometre.
    assert max(len(row["path_m"].replace(".", "").strip("0")) for row in rows) > 12


def test_each_estimate_has_a_name_of_its_own(tsgt: Tsgt, reference: Path, tmp_path: Path) -> None:
    """Also if a file has the name that another one of the same name got."""
    paths = [
        tmp_path / name / file for name, file in (("a", "est"), ("b", "est"), ("c", "est 2"), ("d", "est"))
    ]
    for path in paths:
        path.parent.mkdir()
        write_tum(path.with_suffix(".tum"), TRUE)
    outcome = tsgt("compare", reference, *(path.with_suffix(".tum") for path in paths), "--json")
    assert list(outcome.json()["estimates"]) == ["est", "est 2", "est 2 2", "est 3"]


@pytest.mark.slow
def test_report_is_a_page_with_figures(tsgt: Tsgt, reference: Path, lidar: Path, tmp_path: Path) -> None:
    """And the same numbers as JSON."""
    folder = tmp_path / "report"
    arguments = ("--fit", "offset,extrinsic", "--report", folder, "--json")
    found = tsgt("compare", reference, lidar, *arguments).json()
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "What the fit hides" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    assert json.loads((folder / "report.json").read_text(encoding="utf-8")) == found
    names = {"map", "error_map", "errors_over_time", "components_1", "fit", "drift", "by_motion"}
    assert {path.stem for path in folder.glob("*.pdf")} == names


def test_example_for_a_notebook_runs(
    reference: Path, lidar: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It finds what the command finds."""
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), str(reference), str(lidar)])
    runpy.run_path(str(EXAMPLE))
    first, place, ate, worst = capsys.readouterr().out.splitlines()
    assert float(first.split()[2]) == pytest.approx(1e3 * OFFSET_S, abs=1.0)
    assert "sensor at [0.3" in place
    assert 5.0 < float(ate.split()[1]) < 15.0
    assert worst.startswith("  worst ")


@pytest.mark.parametrize(("arguments", "said"), [
    (("--fit", "offset,colour"), "'colour' is not one of offset, skew, extrinsic, frame, scale, none"),
    (("--fit", "frame", "--align", "none"), "contradict each other"),
    (("--csv", "errors.txt"), "unknown suffix .txt"),
])  # fmt: skip
def test_impossible_options_are_refused(
    tsgt: Tsgt, reference: Path, lidar: Path, arguments: tuple[str, ...], said: str
) -> None:
    """As usage errors, before any work."""
    outcome = tsgt("compare", reference, lidar, *arguments)
    assert outcome.code == 2
    assert said in outcome.err


def test_one_mounting_file_needs_one_estimate(
    tsgt: Tsgt, reference: Path, lidar: Path, tmp_path: Path
) -> None:
    """It has one mounting."""
    outcome = tsgt("compare", reference, lidar, lidar, "--output", tmp_path / "x.toml")
    assert outcome.code == 2
    assert "--output needs one estimate, got 2" in outcome.err


def test_estimate_of_another_day_is_one_line(tsgt: Tsgt, reference: Path, tmp_path: Path) -> None:
    """With the file's name."""
    other = write_tum(tmp_path / "other.tum", TRUE[:400], offset_s=86_400.0)
    outcome = tsgt("compare", reference, other)
    assert outcome.code == 1
    assert outcome.out == ""
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: ")
    assert "other.tum" in line
