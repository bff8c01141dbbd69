"""The commands ``config check`` and ``config schema``."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from harness.cli import tsgt  # noqa: F401 (a fixture)

from tsgt.config import KINDS, json_schema

if TYPE_CHECKING:
    from harness.cli import Tsgt

EXAMPLES = Path(__file__).parents[3] / "configs"

KIND_OF = {
    "master.example": "master",
    "station_frames.example": "station_frames",
    "prism_layout.example": "prism_layout",
    "scenarios/dynamic": "scenario",
}


@pytest.mark.parametrize("name", KIND_OF)
def test_check_says_what_a_file_is(tsgt: Tsgt, name: str) -> None:  # noqa: F811 (a fixture)
    """Each example is recognised by its kind, as text and as JSON."""
    path = EXAMPLES / f"{name}.toml"
    text, as_json = tsgt("config", "check", path), tsgt("config", "check", path, "--json")
    assert (text.code, as_json.code) == (0, 0)
    assert KIND_OF[name] in text.out.splitlines()[0]
    assert as_json.json()["kind"] == KIND_OF[name]
    assert "[1, 2, 3]" in str(as_json.json())


@pytest.mark.parametrize("name", ["client.example", "client.sf8.example"])
def test_check_says_what_a_client_is(tsgt: Tsgt, name: str) -> None:  # noqa: F811 (a fixture)
    """The examples are as the installation guide has them checked."""
    outcome = tsgt("config", "check", EXAMPLES / f"{name}.toml", "--json")
    assert outcome.code == 0
    assert (outcome.json()["kind"], outcome.json()["station"]) == ("client", 1)


@pytest.mark.parametrize("name", ["client.example", "master.example"])
def test_check_refuses_what_the_radio_cannot_do(
    tsgt: Tsgt,  # noqa: F811 (a fixture)
    tmp_path: Path,
    name: str,
) -> None:
    """What the daemon would not start with is no good configuration."""
    for path in EXAMPLES.glob("*.example.toml"):
        shutil.copy(path, tmp_path)
    path = tmp_path / f"{name}.toml"
    path.write_text(path.read_text().replace("frequency_mhz = 905.0", "frequency_mhz = 868.1"))
    outcome = tsgt("config", "check", path)
    assert outcome.code == 2
    assert "not within a band of CA915" in outcome.err


@pytest.mark.parametrize("kind", ["client", "master"])
def test_check_names_protocol_and_key(tsgt: Tsgt, tmp_path: Path, kind: str) -> None:  # noqa: F811 (a fixture)
    """Who copies an example learns that the key is still to be made, and who does without one what that means."""
    for path in EXAMPLES.glob("*.example.toml"):
        shutil.copy(path, tmp_path)
    path = tmp_path / f"{kind}.example.toml"
    found = tsgt("config", "check", path, "--json").json()
    assert found["protocol"] == "superframe"
    assert found["key"].startswith(f"{tmp_path / 'radio.key'} (there is no such file")
    tsgt("radio", "key", tmp_path / "radio.key")
    assert tsgt("config", "check", path, "--json").json()["key"] == str(tmp_path / "radio.key")
    path.write_text(path.read_text().replace('key_file = "radio.key"', ""))
    assert "anybody can take part" in tsgt("config", "check", path).out
    assert "key " not in tsgt("config", "check", tmp_path / f"{kind}.classic.example.toml").out


def test_check_follows_the_set_up_files(tsgt: Tsgt, tmp_path: Path) -> None:  # noqa: F811 (a fixture)
    """A configuration whose set-up files are not there is no good one: exit 2 and one line."""
    shutil.copy(EXAMPLES / "master.example.toml", tmp_path)
    outcome = tsgt("config", "check", tmp_path / "master.example.toml")
    assert outcome.code == 2
    assert outcome.err == f"error: {tmp_path / 'station_frames.example.toml'}: no such file\n"
    assert outcome.out == ""


@pytest.mark.parametrize(
    ("position", "problem"),
    [("[0.4844, -0.1759, 1.4167]", "2"), ("[-1.3962, -0.1759, 0.8167]", "line")],
    ids=["two prisms at one place", "prisms in a line"],
)
@pytest.mark.parametrize("file", ["master", "prism_layout"])
def test_check_refuses_a_degenerate_layout(
    tsgt: Tsgt,  # noqa: F811 (a fixture)
    tmp_path: Path,
    file: str,
    position: str,
    problem: str,
) -> None:
    """Prisms that no pose can come of are found before the robot drives, whichever file is checked."""
    for path in EXAMPLES.glob("*.toml"):
        shutil.copy(path, tmp_path)
    layout = tmp_path / "prism_layout.example.toml"
    layout.write_text(layout.read_text().replace("[-0.0285, 0.3519, 1.0667]", position))
    outcome = tsgt("config", "check", tmp_path / f"{file}.example.toml")
    assert outcome.code == 2
    assert outcome.err.startswith(f"error: {layout}: prisms: ")
    assert problem in outcome.err
    assert outcome.err.count("\n") == 1


def test_check_refuses_a_layout_of_two(tsgt: Tsgt, tmp_path: Path) -> None:  # noqa: F811 (a fixture)
    """Two prisms are too few, and that is said as such."""
    layout = tmp_path / "layout.toml"
    layout.write_text('kind = "prism_layout"\n[prisms.1]\nposition_m = [1, 0, 0]\n')
    outcome = tsgt("config", "check", layout)
    assert (outcome.code, "at least 3 prisms" in outcome.err) == (2, True)


def test_schema_of_everything(tsgt: Tsgt) -> None:  # noqa: F811 (a fixture)
    """Without --kind the schema covers all kinds."""
    assert json.loads(tsgt("config", "schema").out) == json_schema()


@pytest.mark.parametrize("kind", KINDS)
def test_schema_of_one_kind(tsgt: Tsgt, kind: str) -> None:  # noqa: F811 (a fixture)
    """With --kind it is the schema of that kind."""
    assert json.loads(tsgt("config", "schema", "--kind", kind).out)["properties"]["kind"]["const"] == kind


def test_unknown_kind_is_a_usage_error(tsgt: Tsgt) -> None:  # noqa: F811 (a fixture)
    """A kind that does not exist is refused with exit 2."""
    assert tsgt("config", "schema", "--kind", "tripod").code == 2
