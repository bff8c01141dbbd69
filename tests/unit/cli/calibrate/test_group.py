"""``tsgt calibrate targets`` and ``prisms`` on the authors' field data and on the documented examples."""

from __future__ import annotations

import re
import tomllib
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.target_files import write_master, write_targets
from harness.instruments.target_field import TargetField

from tsgt.config import StationFramesFile, load, load_prism_layout, load_station_calibration
from tsgt.geometry.target_calibration import InstrumentError
from tsgt.model import StationParameters

if TYPE_CHECKING:
    from harness.files.cli import Tsgt

REFERENCE = Path(__file__).parents[4] / "docs" / "reference" / "target-file.md"
HOW_TO = Path(__file__).parents[4] / "docs" / "how-to" / "calibrate.md"

PRISM_CONSTANTS = ("--target-constant-mm", 0, "--prism-constant-mm", 10)
"""Constants of the documented examples."""
TARGET_CONSTANT = PRISM_CONSTANTS[:2]


@pytest.fixture
def markers(field_data: Path) -> Path:
    """Return the authors' targets of 14 March 2022: eight targets, three stations."""
    return field_data / "20220314" / "GCP.txt"


def documented(number: int, folder: Path) -> Path:
    """Write one of the examples of the reference page to a file."""
    path = folder / "measured.csv"
    example = re.findall(r"```csv\n(.*?)```", REFERENCE.read_text(encoding="utf-8"), re.DOTALL)[number]
    path.write_text(example, encoding="utf-8")
    return path


def falsified(markers: Path, folder: Path, station: int, target: int, extra_m: float) -> Path:
    """Copy a marker file with one distance changed."""
    lines = []
    for line in markers.read_text(encoding="utf-8").splitlines():
        cells = line.split(" , ")
        if cells[:2] == [str(station), str(target)]:
            cells[5] = repr(float(cells[5]) + extra_m)
        lines.append(" , ".join(cells))
    path = folder / "falsified.txt"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def only(markers: Path, folder: Path, targets: str) -> Path:
    """Copy a marker file with these targets only."""
    lines = markers.read_text(encoding="utf-8").splitlines()
    path = folder / "some.txt"
    kept = [line for line in lines[1:] if line.split(" , ")[1] in targets]
    path.write_text("\n".join([lines[0], *kept]), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("constant_mm", "rms_mm"),
    [(10, {"2": 1.458115, "3": 1.094233}), (0, {"2": 1.966181, "3": 2.447351})],
)
def test_field_targets_give_the_published_residuals(
    tsgt: Tsgt, markers: Path, constant_mm: int, rms_mm: dict[str, float]
) -> None:
    """Unweighted, all eight targets: the unique optimum, to a nanometre."""
    done = tsgt(
        "calibrate", "targets", markers, "--target-constant-mm", constant_mm, "--weights", "none", "--json"
    )
    assert done.code == 0
    stations = done.json()["stations"]
    assert {number: station["rms_mm"] for number, station in stations.items()} == pytest.approx(
        rms_mm, abs=1e-6
    )
    assert all(station["used"] == [1, 2, 3, 4, 5, 6, 7, 8] for station in stations.values())


@pytest.mark.parametrize("day", ["20220314", "20220331-1"])
@pytest.mark.parametrize("weights", ["model", "none"])
def test_field_data_is_consistent(tsgt: Tsgt, field_data: Path, day: str, weights: str) -> None:
    """No target is rejected, no frame is weak or inconsistent, and no residual exceeds 5 mm."""
    done = tsgt(
        "calibrate", "targets", field_data / day / "GCP.txt", "--target-constant-mm", 10, "--weights", weights,
        "--json",
    )  # fmt: skip
    assert done.code == 0
    assert done.err == ""
    for station in done.json()["stations"].values():
        assert station["rejected"] == []
        assert station["weak"] == []
        assert station["consistent"] is True
        assert station["max_mm"] < 5


@pytest.mark.parametrize(("weights", "limit_mm"), [("none", 1.6), ("model", 1.6)])
@pytest.mark.parametrize("station", [1, 2, 3])
@pytest.mark.slow
def test_falsified_target_is_rejected(
    tsgt: Tsgt, markers: Path, tmp_path: Path, station: int, weights: str, limit_mm: float
) -> None:
    """An error of 50 mm is rejected by every station concerned, the other targets stay."""
    for target, extra_m in product(range(1, 9), (0.05, -0.05)):
        done = tsgt(
            "calibrate", "targets", falsified(markers, tmp_path, station, target, extra_m),
            "--target-constant-mm", 10, "--weights", weights, "--json",
        )  # fmt: skip
        assert done.code == 0
        for number, solved in done.json()["stations"].items():
            concerned = station in (1, int(number))
            assert solved["rejected"] == ([target] if concerned else [])
            assert (target in solved["used"]) != concerned
            assert solved["rms_mm"] < limit_mm
        assert done.err.count("rejected") == 1
        assert f"station {station}: target {target} rejected" in done.err
        # Of a target near the station nearly certain only: it might have moved along the line of sight.
        assert "the station erred, its distance is wrong" in done.err or ", its distance) or" in done.err


@pytest.mark.parametrize("targets", ["1234", "1235", "1245", "1345", "2345"])
def test_nearly_collinear_targets_are_weak(tsgt: Tsgt, markers: Path, tmp_path: Path, targets: str) -> None:
    """The direction of the line is reported with exit code 3; the frame is printed."""
    done = tsgt(
        "calibrate", "targets", only(markers, tmp_path, targets), "--target-constant-mm", 10, "--json"
    )
    assert done.code == 3
    for station in done.json()["stations"].values():
        (weak,) = station["weak"]
        # From station 1 these targets lie at 0.80 to 0.63 rad, the near ones at the larger angle.
        assert weak["bearing_deg"] == pytest.approx(34, abs=1)
        assert weak["elevation_deg"] == pytest.approx(0, abs=1)
        assert 1 < weak["sigma_mrad"] < 10
    assert "weak" in done.err
    assert "bearing 3" in done.err


def test_collinear_targets_suffice_for_levelled_stations(tsgt: Tsgt, markers: Path, tmp_path: Path) -> None:
    """With --levelled the same four targets determine the frame."""
    path = only(markers, tmp_path, "1234")
    done = tsgt("calibrate", "targets", path, "--target-constant-mm", 10, "--levelled", "--json")
    assert all(station["weak"] == [] for station in done.json()["stations"].values())


def test_table_lists_every_target(tsgt: Tsgt, markers: Path, tmp_path: Path) -> None:
    """A rejected target is marked."""
    done = tsgt("calibrate", "targets", falsified(markers, tmp_path, 2, 5, 0.05), "--target-constant-mm", 10)
    assert "station 2: 7 targets used, rms 1.04 mm" in done.out
    assert re.search(r"^5 +rejected +5[01]\.\d\d$", done.out, re.MULTILINE)
    assert re.search(r"station 3: 8 targets used, rms 1\.\d\d mm", done.out)


def test_set_up_file_reproduces_the_frames_exactly(tsgt: Tsgt, tmp_path: Path) -> None:
    """The configuration reads exactly the printed frames, station 1 included."""
    output = tmp_path / "frames.toml"
    done = tsgt(
        "calibrate", "targets", documented(0, tmp_path), *TARGET_CONSTANT, "--json", "--output", output
    )
    assert done.code == 0
    frames = {
        number: each.T_station1_station for number, each in load_station_calibration(output).stations.items()
    }
    assert np.array(frames[2]).tolist() == done.json()["stations"]["2"]["T_station1_station"]
    np.testing.assert_array_equal(frames[1], np.eye(4))
    assert output.read_text(encoding="utf-8").startswith("# written by tsgt calibrate targets ")
    written = load(output, StationFramesFile).stations
    assert written["1"].rms_mm is None
    assert written["2"].rms_mm == pytest.approx(done.json()["stations"]["2"]["rms_mm"], abs=1e-3)


def test_inconsistent_targets_are_not_written(tsgt: Tsgt, tmp_path: Path) -> None:
    """One of four targets is wrong: exit code 3, residuals on stdout, reason on stderr, no file."""
    path, output = documented(0, tmp_path), tmp_path / "frames.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("20.4692", "20.5192"), encoding="utf-8")
    done = tsgt("calibrate", "targets", path, *TARGET_CONSTANT, "--json", "--output", output)
    assert done.code == 3
    assert done.json()["stations"]["2"]["consistent"] is False
    assert "are inconsistent" in done.err
    assert not output.exists()


@pytest.mark.parametrize("weights", ["model", "none"])
def test_excluded_target_is_the_way_on(tsgt: Tsgt, tmp_path: Path, weights: str) -> None:
    """The printed command leaves the suspect out; exit codes do not depend on the weights."""
    path, output = documented(0, tmp_path), tmp_path / "frames.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("20.4692", "20.5192"), encoding="utf-8")
    arguments = ("calibrate", "targets", path, *TARGET_CONSTANT, "--weights", weights, "--output", output)
    refused = tsgt(*arguments)
    assert refused.code == 3
    assert f"{output} is not written: the targets are inconsistent" in refused.out
    assert re.search(r"noise scale \d+\.\d+, limit \d\.\d+", refused.err)
    (left_out,) = re.findall(r"--exclude (\S+) --output", refused.err)
    assert left_out == "2"
    done = tsgt(*arguments, "--exclude", left_out, "--json")
    assert done.json()["written"]["path"] == str(output)
    assert done.json()["stations"]["2"]["used"] == [1, 3, 4]
    assert all(check["ok"] for check in done.json()["checks"] if "noise_scale" in check["name"])


def test_tripod_that_moved_names_the_way_on(tsgt: Tsgt, tmp_path: Path) -> None:
    """The command that is printed leaves out what was measured before it moved, and succeeds."""
    moved = (1, 4, np.array([0.006, -0.004, 0.003, 2e-4]))
    path = write_targets(TargetField(rng=np.random.default_rng(2), targets=9, moved_tripod=moved), tmp_path)
    done = tsgt("calibrate", "targets", path, *TARGET_CONSTANT)
    assert done.code == 3
    assert "--exclude 2:1,2:2,2:3,2:4" in done.err.splitlines()[-1]
    assert tsgt("calibrate", "targets", path, *TARGET_CONSTANT, "--exclude", "2:1,2:2,2:3,2:4").code == 0


def test_residual_limit_accepts_the_rest(tsgt: Tsgt, tmp_path: Path) -> None:
    """The limit is a check of its own, printed with its value."""
    path = documented(0, tmp_path)
    path.write_text(path.read_text(encoding="utf-8").replace("20.4692", "20.5192"), encoding="utf-8")
    done = tsgt("calibrate", "targets", path, *TARGET_CONSTANT, "--max-residual-mm", 10, "--json")
    (check,) = (c for c in done.json()["checks"] if c["name"] == "station 2 max_residual_mm")
    assert check["value"] < check["limit"] == 10
    assert check["ok"] is True


@pytest.mark.parametrize("exclude", ["99", "2:99"])
def test_unknown_exclusion_is_an_error(tsgt: Tsgt, tmp_path: Path, exclude: str) -> None:
    """A wrong number must not go unnoticed."""
    done = tsgt("calibrate", "targets", documented(0, tmp_path), *TARGET_CONSTANT, "--exclude", exclude)
    assert done.code == 1
    assert "no measurement of target 99" in done.err


def test_instrument_error_is_written(tsgt: Tsgt, tmp_path: Path) -> None:
    """An index error of 0.3 mrad at station 2 is named, applied and written, with the joint covariance."""
    field = TargetField(
        rng=np.random.default_rng(1), errors={(1, InstrumentError.VERTICAL_INDEX): 3e-4}, both_faces=True
    )
    path, output = write_targets(field, tmp_path), tmp_path / "frames.toml"
    done = tsgt("calibrate", "targets", path, *TARGET_CONSTANT, "--output", output)
    assert done.code == 0
    assert "station 2: the residuals look like a vertical index error" in done.err
    assert f"{output}: frames of stations 1, 2, 3, instrument errors" in done.out
    written = load_station_calibration(output)
    assert written.stations[2].vertical_index_rad == pytest.approx(3e-4, abs=2e-5)
    assert written.covariance is not None
    assert "station1.vertical_index" in written.covariance.components


def test_common_scale_leaves_the_configured_one_in_force(tsgt: Tsgt, tmp_path: Path) -> None:
    """Targets do not show a scale of all stations, of distances without atmospheric correction: the file has none."""
    field = TargetField(
        rng=np.random.default_rng(1), errors={(row, InstrumentError.RANGE_SCALE): 6e-5 for row in range(3)}
    )
    output = tmp_path / "frames.toml"
    done = tsgt("calibrate", "targets", write_targets(field, tmp_path), *TARGET_CONSTANT, "--output", output)
    assert done.code == 0
    assert "replaces" not in done.err
    stations = load_station_calibration(output).stations
    assert [stations[station].range_scale_ppm for station in (1, 2, 3)] == [None, None, None]
    configured = StationParameters(station=2, prism=2, atmospheric_ppm=60.0)
    assert stations[2].applied(configured).atmospheric_ppm == 60.0


def test_scale_that_is_a_cause_is_written_with_a_note(tsgt: Tsgt, tmp_path: Path) -> None:
    """A scale of one station is written for this station only; the note says what it replaces."""
    field = TargetField(rng=np.random.default_rng(2), errors={(1, InstrumentError.RANGE_SCALE): 1e-4}, far=3)
    output = tmp_path / "frames.toml"
    done = tsgt(
        "calibrate", "targets", write_targets(field, tmp_path), *TARGET_CONSTANT, "--output", output, "--json"
    )
    assert done.code == 0
    stations = load_station_calibration(output).stations
    assert stations[2].range_scale_ppm == pytest.approx(100, abs=15)
    assert [stations[station].range_scale_ppm for station in (1, 3)] == [None, None]
    assert f"{output} has the scale of station 2's distances, " in done.err
    assert "ppm; it replaces atmospheric_ppm of the configuration" in done.json()["notes"][-1]


def test_scale_that_is_a_cause_contains_the_correction_of_the_file(tsgt: Tsgt, tmp_path: Path) -> None:
    """It replaces that of the configuration, with which the distances of the targets were corrected."""
    field = TargetField(
        rng=np.random.default_rng(2), errors={(1, InstrumentError.RANGE_SCALE): 1.3e-4}, far=3
    )
    path, output = write_targets(field, tmp_path, ppm=(0.0, 30.0, 0.0)), tmp_path / "frames.toml"
    assert tsgt("calibrate", "targets", path, *TARGET_CONSTANT, "--output", output).code == 0
    assert load_station_calibration(output).stations[2].range_scale_ppm == pytest.approx(130, abs=15)


@pytest.mark.parametrize(("ppm", "named"), [((), True), ((0.0, 40.0, 0.0), False)])
def test_targets_without_the_correction_of_the_master_are_named(
    tsgt: Tsgt, tmp_path: Path, ppm: tuple[float, ...], *, named: bool
) -> None:
    """Frames and poses would differ in scale: 40 ppm are 4 mm at 100 m."""
    path = write_targets(TargetField(rng=np.random.default_rng(2)), tmp_path, ppm=ppm)
    master = tmp_path / "master.toml"
    write_master(master, ppm=(0.0, 40.0, 0.0))
    done = tsgt("calibrate", "targets", path, *TARGET_CONSTANT, "--apply", master)
    assert done.code == 0, done.err
    assert ("station 2: " in done.err and "has atmospheric_ppm = 40" in done.err) is named


def test_prisms_are_solved_and_written(tsgt: Tsgt, tmp_path: Path) -> None:
    """The documented example gives positions, distances, body residuals, and a layout file with the same bits."""
    output = tmp_path / "layout.toml"
    done = tsgt(
        "calibrate",
        "prisms",
        documented(2, tmp_path),
        *PRISM_CONSTANTS,
        "--json",
        "--output",
        output,
    )
    assert done.code == 0
    solved = done.json()
    assert solved["distances_mm"] == pytest.approx({"1-2": 987.0, "1-3": 681.6, "2-3": 814.7}, abs=1.0)
    assert solved["rms_mm"] < 1
    assert solved["used"] == ["front_left", "front_right", "rear_left", "mast"]
    layout = load_prism_layout(output).positions_m
    assert {str(prism): list(position) for prism, position in layout.items()} == solved["prisms"]


def test_prisms_as_text(tsgt: Tsgt, tmp_path: Path) -> None:
    """The text has prisms, distances and body points."""
    done = tsgt("calibrate", "prisms", documented(2, tmp_path), *PRISM_CONSTANTS)
    assert done.code == 0
    assert re.search(r"^2 +0\.4838 +-0\.1757 +1\.4171", done.out, re.MULTILINE)
    assert re.search(r"^1-2 +986\.72$", done.out, re.MULTILINE)
    assert re.search(r"^mast +0\.24", done.out, re.MULTILINE)


@pytest.mark.parametrize(
    ("command", "example", "missing"),
    [("targets", 0, "target"), ("prisms", 2, "target"), ("prisms", 2, "prism")],
)
def test_constants_have_no_default(
    tsgt: Tsgt, tmp_path: Path, command: str, example: int, missing: str
) -> None:
    """A line without constant_mm needs the option; the usage error names the line."""
    index = PRISM_CONSTANTS.index(f"--{missing}-constant-mm")
    others = PRISM_CONSTANTS[:index] + PRISM_CONSTANTS[index + 2 :] if command == "prisms" else ()
    path = documented(example, tmp_path)
    done = tsgt("calibrate", command, path, *others)
    assert (done.code, done.out) == (2, "")
    assert f"{path}, line " in done.err
    assert f"has no constant_mm; give --{missing}-constant-mm" in done.err


def test_invalid_file_is_one_line(tsgt: Tsgt, tmp_path: Path) -> None:
    """Exit code 1, one line on stderr, no output file."""
    path, output = tmp_path / "empty.csv", tmp_path / "frames.toml"
    path.touch()
    for command in ("targets", "prisms"):
        done = tsgt("calibrate", command, path, "--output", output)
        assert (done.code, done.out) == (1, "")
        assert done.err.count("\n") == 1
        assert "is empty" in done.err
    assert not output.exists()


def test_line_break_in_a_file_name_is_escaped(tsgt: Tsgt, tmp_path: Path) -> None:
    """A line break in the input file's name does not get into the TOML."""
    path, output = tmp_path / 'a\nkind = "x"', tmp_path / "frames.toml"
    documented(0, tmp_path).rename(path)
    assert tsgt("calibrate", "targets", path, *TARGET_CONSTANT, "--output", output).code == 0
    assert tomllib.loads(output.read_text(encoding="utf-8"))["kind"] == "station_frames"


@pytest.mark.parametrize(
    ("command", "example", "section"),
    [("targets", 0, "## Station frames"), ("prisms", 2, "## Prism layout")],
)
def test_every_json_key_is_documented(
    tsgt: Tsgt, tmp_path: Path, command: str, example: int, section: str
) -> None:
    """Each key of the JSON output is in the how-to page."""
    printed: dict[str, Any] = tsgt(
        "calibrate",
        command,
        documented(example, tmp_path),
        *(TARGET_CONSTANT if command == "targets" else PRISM_CONSTANTS),
        "--json",
    ).json()
    keys = (
        set(printed["stations"]["2"])
        if command == "targets"
        else {"prisms", "prism_sigma_mm", "distances_mm"}
    )
    page = HOW_TO.read_text(encoding="utf-8")
    text = page[page.index(section) :]
    assert [key for key in keys if f"`.{key}" not in text and f"`{key}" not in text] == []


def test_levelled_detects_a_tilted_station(tsgt: Tsgt, markers: Path) -> None:
    """Station 2 of the field data is tilted by a third of a milliradian: exit code 3."""
    done = tsgt("calibrate", "targets", markers, "--target-constant-mm", 10, "--levelled", "--json")
    assert done.code == 3
    stations = done.json()["stations"]
    assert stations["2"]["tilt_mrad"] == pytest.approx(0.34, abs=0.03)
    assert stations["3"]["tilt_mrad"] is None
    assert "station 2: not level with station 1" in done.err
