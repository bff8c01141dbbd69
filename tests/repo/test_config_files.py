"""The example configurations and the schema in the repository are those of the code."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from tsgt.config import MasterConfig, ScenarioConfig, json_schema, load, load_any, parameters
from tsgt.config import scenario_parameters as si

CONFIGS = Path(__file__).parents[2] / "configs"
EXAMPLES = sorted(CONFIGS.rglob("*.toml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_loads(path: Path) -> None:
    """Whoever copies an example starts with a file that works."""
    load_any(path)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_fits_the_schema(path: Path) -> None:
    """An editor that knows the schema finds nothing wrong in an example."""
    jsonschema.validate(tomllib.loads(path.read_text()), json_schema())


def test_the_schema_file_is_fresh() -> None:
    """The schema file is what `tsgt config schema` prints now."""
    stored = json.loads((CONFIGS / "schema" / "config.schema.json").read_text())
    assert stored == json_schema(), "run `tsgt config schema > configs/schema/config.schema.json`"


def test_the_reference_scenario_is_the_default() -> None:
    """`dynamic.toml` and no file at all are the same world."""
    assert load(CONFIGS / "scenarios" / "dynamic.toml", ScenarioConfig) == ScenarioConfig()


def test_the_reference_scenario_spells_everything_out() -> None:
    """Every value of the scenario can be read in its file."""
    written = tomllib.loads((CONFIGS / "scenarios" / "dynamic.toml").read_text())
    assert _keys(written) == _keys(ScenarioConfig().model_dump())


@pytest.mark.parametrize("name", ["master", "master.classic"])
def test_the_master_examples_spell_the_defaults_out(name: str) -> None:
    """What an example calls a default is one, and it leaves out nothing of its protocol."""
    raw = tomllib.loads((CONFIGS / f"{name}.example.toml").read_text())
    minimal = {key: raw[key] for key in ("kind", "setup", "stations")}
    minimal["radio"] = {
        key: raw["radio"][key] for key in ("kind", "frequency_mhz", "spreading_factor", "region")
    }
    minimal["protocol"] = {
        key: raw["protocol"][key] for key in ("kind", "key_file") if key in raw["protocol"]
    }
    config = MasterConfig.model_validate_json(json.dumps(minimal))
    spelt = MasterConfig.model_validate_json(json.dumps(raw))
    assert spelt == config
    assert set(raw["protocol"]) == set(type(spelt.protocol).model_fields)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.example.toml")), ids=lambda path: path.stem)
def test_every_example_says_why_it_speaks_its_protocol(path: Path) -> None:
    """There is no silent choice: beside the name of the protocol stands the reason."""
    _, given, protocol = path.read_text().partition("[protocol]\n")
    assert "because" in protocol.partition("\n[")[0] or not given


def test_the_geofence_in_the_master_example_works() -> None:
    """It is commented out; whoever takes the comment signs away has a fence, with the defaults spelt out."""
    text = (CONFIGS / "master.example.toml").read_text()
    start = text.index("# [[geofences]]")
    fence = "\n".join(line[2:] for line in text[start : text.index("\n\n", start)].splitlines())
    config = MasterConfig.model_validate_json(json.dumps(tomllib.loads(text + fence)))
    (written,) = config.geofences
    assert written == written.model_copy(update={"sigmas": 3.0, "hysteresis_m": 0.5, "lost_after_s": 2.0})


def test_the_set_up_examples_are_those_of_the_reference_scenario() -> None:
    """The example set-up is the simulated one, so that it can be tried out."""
    example = parameters(load(CONFIGS / "master.example.toml", MasterConfig))
    scenario = si(ScenarioConfig())
    assert example.prisms == scenario.prisms
    frames = [station.T_station1_station for station in example.stations]
    for frame, station in zip(frames, scenario.stations, strict=True):
        for row, expected in zip(frame, station.T_station1_station, strict=True):
            assert row == pytest.approx(expected, abs=1e-15)


def _keys(content: Any, path: str = "") -> set[str]:
    if isinstance(content, dict):
        return {found for key, value in content.items() for found in _keys(value, f"{path}.{key}")}
    if isinstance(content, list | tuple) and content and isinstance(content[0], dict):
        return {found for entry in content for found in _keys(entry, path)}
    return {path}
