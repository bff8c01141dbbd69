"""``tsgt config check`` and ``config schema``."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.cli import tsgt  # noqa: F401 (a fixture)

from tsgt.config import KINDS, json_schema

if TYPE_CHECKING:
    from harness.files.cli import Outcome, Tsgt

EXAMPLES = Path(__file__).parents[3] / "configs"

KIND_OF = {
    "master.example": "master",
    "station_frames.example": "station_frames",
    "prism_layout.example": "prism_layout",
    "dynamic": "scenario",
}


@pytest.fixture
def examples(tsgt: Tsgt, tmp_path: Path) -> Path:  # noqa: F811 (a fixture)
    """Copy the examples, and make the key that they name."""
    for path in [*EXAMPLES.glob("*.example.toml"), EXAMPLES / "scenarios" / "dynamic.toml"]:
        shutil.copy(path, tmp_path)
    assert tsgt("radio", "key", tmp_path / "radio.key").code == 0
    return tmp_path


MOUNTING = """kind = "imu_mounting"
position_m = [0.21, -0.12, 0.43]
orientation_xyzw = [0.0, 0.0, 0.0, 1.0]
latency_ms = 0.0
gyro_matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
"""


def master_with_imu(folder: Path) -> Path:
    """Return the example of two stations, changed so that the file imu.toml has the mounting."""
    path = folder / "master.two-stations.example.toml"
    mounting = {"position_m": 'mounting = "imu.toml"', "orientation_xyzw": "", "latency_ms": ""}
    lines = path.read_text().splitlines()
    path.write_text("\n".join(mounting.get(line.partition(" ")[0], line) for line in lines))
    return path


def summary(outcome: Outcome) -> dict[str, Any]:
    """Return the JSON summary of a single checked file."""
    (found,) = outcome.json()["files"]
    return dict(found)


@pytest.mark.parametrize("name", KIND_OF)
def test_check_reports_the_kind_of_a_file(tsgt: Tsgt, examples: Path, name: str) -> None:  # noqa: F811 (a fixture)
    """As text and as JSON."""
    path = examples / f"{name}.toml"
    text, as_json = tsgt("config", "check", path), tsgt("config", "check", path, "--json")
    assert (text.code, as_json.code) == (0, 0)
    assert KIND_OF[name] in text.out.splitlines()[0]
    assert summary(as_json)["kind"] == KIND_OF[name]
    assert "[1, 2, 3]" in str(as_json.json())


@pytest.mark.parametrize("name", ["client.example", "client.sf8.example"])
def test_check_summarises_a_client(tsgt: Tsgt, examples: Path, name: str) -> None:  # noqa: F811 (a fixture)
    """The installation guide has these examples checked."""
    outcome = tsgt("config", "check", examples / f"{name}.toml", "--json")
    assert outcome.code == 0
    assert (summary(outcome)["kind"], summary(outcome)["station"]) == ("client", 1)


def test_check_takes_all_examples_at_once(tsgt: Tsgt, examples: Path) -> None:  # noqa: F811 (a fixture)
    """Each file has a summary."""
    files = sorted(examples.glob("*.toml"))
    found = tsgt("config", "check", *files, "--json")
    assert (found.code, found.json()["ok"]) == (0, True)
    assert [Path(each["file"]) for each in found.json()["files"]] == files
    text = tsgt("config", "check", *files)
    assert [line for line in text.out.splitlines() if line.startswith("#")] == [f"# {path}" for path in files]


def test_check_reports_all_problems_of_all_files(tsgt: Tsgt, examples: Path) -> None:  # noqa: F811 (a fixture)
    """One line for each problem; valid files are summarised nevertheless."""
    client, layout = examples / "client.example.toml", examples / "prism_layout.example.toml"
    client.write_text(
        client.read_text().replace("baud = ", "baudrate = ").replace("station = 1", "station = 99")
    )
    master = examples / "master.example.toml"
    (examples / "station_frames.example.toml").write_text("nonsense")
    outcome = tsgt("config", "check", client, master, layout)
    assert outcome.code == 2
    lines = outcome.err.splitlines()
    assert all(line.startswith("error: ") for line in lines)
    assert [any(words in line for line in lines) for words in ("baudrate: unknown key", "station = 99")] == [
        True,
        True,
    ]
    assert any(
        line.startswith(f"error: {examples / 'station_frames.example.toml'}: not TOML") for line in lines
    )
    assert str(layout) in outcome.out
    report = tsgt("config", "check", client, layout, "--json")
    assert report.code == 2
    assert [each["ok"] for each in report.json()["files"]] == [False, True]
    assert len(report.json()["files"][0]["errors"]) == len(lines) - 1


@pytest.mark.parametrize("name", ["client.example", "master.example"])
def test_check_rejects_an_illegal_channel(tsgt: Tsgt, examples: Path, name: str) -> None:  # noqa: F811 (a fixture)
    """The daemon would not start."""
    path = examples / f"{name}.toml"
    path.write_text(path.read_text().replace("frequency_mhz = 905.0", "frequency_mhz = 868.1"))
    outcome = tsgt("config", "check", path)
    assert outcome.code == 2
    assert "not within a band of CA915" in outcome.err


@pytest.mark.parametrize("kind", ["client", "master"])
def test_check_needs_the_key(tsgt: Tsgt, examples: Path, kind: str) -> None:  # noqa: F811 (a fixture)
    """A missing key or one with wrong permissions fails; without a key the summary warns."""
    path, key = examples / f"{kind}.example.toml", examples / "radio.key"
    found = summary(tsgt("config", "check", path, "--json"))
    assert (found["protocol"], found["key"]) == ("superframe", str(key))
    key.chmod(0o644)
    outcome = tsgt("config", "check", path)
    assert (outcome.code, f"`chmod 600 {key}`" in outcome.err) == (2, True)
    key.unlink()
    outcome = tsgt("config", "check", path)
    assert (outcome.code, f"error: {key}: no such file" in outcome.err) == (2, True)
    path.write_text(path.read_text().replace('key_file = "radio.key"', ""))
    assert "anybody can take part" in tsgt("config", "check", path).out
    assert "key " not in tsgt("config", "check", examples / f"{kind}.classic.example.toml").out


@pytest.mark.parametrize("name", ["prism_layout.example.toml", "imu.toml"])
def test_check_rejects_world_writable_files(tsgt: Tsgt, examples: Path, name: str) -> None:  # noqa: F811 (a fixture)
    """The daemon would not start with them."""
    master = master_with_imu(examples)
    (examples / "imu.toml").write_text(MOUNTING)
    assert tsgt("config", "check", master).code == 0
    (examples / name).chmod(0o666)
    outcome = tsgt("config", "check", master)
    assert (outcome.code, outcome.err.count("chmod o-w")) == (2, 1)


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize(
    ("mounting", "problem"),
    [
        (None, "no such file"),
        (
            MOUNTING.replace("latency_ms = 0.0", "latency_ms = true"),
            "latency_ms = true: should be a valid number",
        ),
        ('kind = "prism_layout"\n[prisms.1]\nposition_m = [1, 0, 0]\n', 'kind "imu_mounting" is expected'),
    ],
    ids=["missing", "invalid", "another kind"],
)
def test_check_needs_the_mounting_of_the_imu(
    tsgt: Tsgt,  # noqa: F811 (a fixture)
    examples: Path,
    mounting: str | None,
    problem: str,
    calibrated: bool,  # noqa: FBT001 (a parameter)
) -> None:
    """Also before the first calibration; the reports of other files are not lost."""
    master, layout = master_with_imu(examples), examples / "prism_layout.example.toml"
    if mounting is not None:
        (examples / "imu.toml").write_text(mounting)
    if not calibrated:
        (examples / "station_frames.example.toml").unlink()
    outcome = tsgt("config", "check", layout, master, "--json")
    assert outcome.code == 2
    accepted, rejected = outcome.json()["files"]
    assert (accepted["ok"], len(rejected["errors"])) == (True, 1)
    assert rejected["errors"][0].startswith(f"{examples / 'imu.toml'}: ")
    assert problem in rejected["errors"][0]


def test_check_rejects_what_is_no_file(tsgt: Tsgt, tmp_path: Path) -> None:  # noqa: F811 (a fixture)
    """A pipe that nobody writes would block for ever."""
    os.mkfifo(tmp_path / "pipe")
    outcome = tsgt("config", "check", tmp_path / "pipe")
    assert (outcome.code, outcome.err) == (
        2,
        f"error: {tmp_path / 'pipe'}: is a device or pipe, not a file; name a configuration\n",
    )


def test_check_accepts_a_licence_outside_of_the_bands(tsgt: Tsgt, examples: Path) -> None:  # noqa: F811 (a fixture)
    """The bands of the region do not apply with it."""
    master = examples / "master.example.toml"
    text = master.read_text()
    master.write_text(text.replace("frequency_mhz = 905.0", 'frequency_mhz = 433.92\nlicence = "VE2XYZ"'))
    outcome = tsgt("config", "check", master)
    assert (outcome.code, outcome.err) == (0, "")


def test_check_accepts_a_master_before_its_calibration(tsgt: Tsgt, examples: Path) -> None:  # noqa: F811 (a fixture)
    """It starts without its set-up files; the summary says that there are no poses, and how the files are made."""
    names = {"station_frames.example.toml": "targets", "prism_layout.example.toml": "prisms"}
    for name in names:
        (examples / name).unlink()
    outcome = tsgt("config", "check", examples / "master.example.toml")
    assert (outcome.code, outcome.err) == (0, "")
    assert "no poses        not calibrated: " in outcome.out
    for name, command in names.items():
        assert f"{examples / name} (`tsgt calibrate {command}` writes it)" in outcome.out


@pytest.mark.parametrize(
    ("position", "problem"),
    [("[0.4844, -0.1759, 1.4167]", "2"), ("[-1.3962, -0.1759, 0.8167]", "line")],
    ids=["two prisms at one place", "prisms in a line"],
)
@pytest.mark.parametrize("file", ["master", "prism_layout"])
def test_check_rejects_a_degenerate_layout(
    tsgt: Tsgt,  # noqa: F811 (a fixture)
    examples: Path,
    file: str,
    position: str,
    problem: str,
) -> None:
    """In the configuration of a master and in the layout itself."""
    layout = examples / "prism_layout.example.toml"
    layout.write_text(layout.read_text().replace("[-0.0285, 0.3519, 1.0667]", position))
    outcome = tsgt("config", "check", examples / f"{file}.example.toml")
    assert outcome.code == 2
    assert outcome.err.startswith(f"error: {layout}: prisms: ")
    assert problem in outcome.err
    assert outcome.err.count("\n") == 1


def test_layout_of_one_prism_needs_an_imu(tsgt: Tsgt, tmp_path: Path) -> None:  # noqa: F811 (a fixture)
    """The file alone does not tell whether the robot has one."""
    layout = tmp_path / "layout.toml"
    layout.write_text('kind = "prism_layout"\n[prisms.1]\nposition_m = [1, 0, 0]\n')
    outcome = tsgt("config", "check", layout)
    assert (outcome.code, "needs           an IMU" in outcome.out) == (0, True)


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (("[imu]", "[imu_]"), "imu_: unknown key"),
        (("[pipeline]", '[pipeline]\nestimator = "linear"'), "2 stations on 2 prisms and an IMU need the"),
    ],
)
def test_check_says_what_two_stations_need(
    tsgt: Tsgt,  # noqa: F811 (a fixture)
    examples: Path,
    edit: tuple[str, str],
    problem: str,
) -> None:
    """Besides the IMU, the estimator that uses it."""
    master = examples / "master.two-stations.example.toml"
    outcome = tsgt("config", "check", master)
    assert (outcome.code, outcome.err) == (0, "")
    assert "imu             imu" in outcome.out
    master.write_text(master.read_text().replace(*edit))
    outcome = tsgt("config", "check", master)
    assert outcome.code == 2
    assert problem in outcome.err


@pytest.mark.parametrize(("stations", "setup"), [(1, "1 station on 1 prism"), (2, "2 stations on 2 prisms")])
def test_check_rejects_few_stations_without_imu(
    tsgt: Tsgt,  # noqa: F811 (a fixture)
    examples: Path,
    stations: int,
    setup: str,
) -> None:
    """With the file, and what to do."""
    master = examples / "master.example.toml"
    master.write_text(master.read_text().partition(f"[[stations]]\nstation = {stations + 1}")[0])
    outcome = tsgt("config", "check", master)
    assert outcome.code == 2
    assert outcome.err == (
        f"error: {master}: stations: {setup} cannot give poses without an IMU: add the table [imu], or stations until 3 "
        "prisms are tracked\n"
    )


def test_schema_of_all_kinds(tsgt: Tsgt) -> None:  # noqa: F811 (a fixture)
    """Without --kind the schema covers all kinds."""
    assert json.loads(tsgt("config", "schema").out) == json_schema()


@pytest.mark.parametrize("kind", KINDS)
def test_schema_of_one_kind(tsgt: Tsgt, kind: str) -> None:  # noqa: F811 (a fixture)
    """With --kind it is the schema of that kind."""
    assert json.loads(tsgt("config", "schema", "--kind", kind).out)["properties"]["kind"]["const"] == kind


def test_unknown_kind_is_a_usage_error(tsgt: Tsgt) -> None:  # noqa: F811 (a fixture)
    """Exit code 2."""
    assert tsgt("config", "schema", "--kind", "tripod").code == 2
