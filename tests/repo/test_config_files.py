"""The example configurations and the schema in the repository are up to date."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from tsgt.config import ClientConfig, MasterConfig, ScenarioConfig, json_schema, load, load_any, parameters
from tsgt.config import scenario_parameters as si
from tsgt.radio.legality import legality
from tsgt.radio.planning import REGIONS

CONFIGS = Path(__file__).parents[2] / "configs"
VALIDATOR = jsonschema.validators.validator_for(json_schema())(json_schema())
EXAMPLES = sorted(CONFIGS.rglob("*.toml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_loads(path: Path) -> None:
    """Every example is a valid file."""
    load_any(path)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_fits_the_schema(path: Path) -> None:
    """An editor that knows the schema reports no problem."""
    VALIDATOR.validate(tomllib.loads(path.read_text()))


def test_schema_file_is_fresh() -> None:
    """The schema file is the output of `tsgt config schema`."""
    stored = json.loads((CONFIGS / "schema" / "config.schema.json").read_text())
    assert stored == json_schema(), "run `tsgt config schema > configs/schema/config.schema.json`"


def test_reference_scenario_is_the_default() -> None:
    """`dynamic.toml` and no file are the same world."""
    assert load(CONFIGS / "scenarios" / "dynamic.toml", ScenarioConfig) == ScenarioConfig()


def test_reference_scenario_has_every_key() -> None:
    """Every value of the scenario is in its file."""
    written = tomllib.loads((CONFIGS / "scenarios" / "dynamic.toml").read_text())
    assert _keys(written) == _keys(ScenarioConfig().model_dump())


@pytest.mark.parametrize("name", ["master", "master.classic"])
def test_master_examples_state_the_defaults(name: str) -> None:
    """The values called defaults are the defaults, and all keys of the protocol are present."""
    raw = tomllib.loads((CONFIGS / f"{name}.example.toml").read_text())
    minimal = {key: raw[key] for key in ("kind", "setup", "stations")}
    minimal["radio"] = {
        key: raw["radio"][key]
        for key in (
            "kind",
            "frequency_mhz",
            "spreading_factor",
            "bandwidth_khz",
            "region",
            "antenna_gain_dbi",
        )
    }
    minimal["protocol"] = {
        key: raw["protocol"][key] for key in ("kind", "key_file") if key in raw["protocol"]
    }
    config = MasterConfig.model_validate_json(json.dumps(minimal))
    spelt = MasterConfig.model_validate_json(json.dumps(raw))
    assert spelt == config
    assert set(raw["protocol"]) == set(type(spelt.protocol).model_fields)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.example.toml")), ids=lambda path: path.stem)
def test_every_example_gives_the_reason_for_its_protocol(path: Path) -> None:
    """There is no silent default."""
    _, given, protocol = path.read_text().partition("[protocol]\n")
    assert "because" in protocol.partition("\n[")[0] or not given


DAEMON_EXAMPLES = sorted([*CONFIGS.glob("client*.example.toml"), *CONFIGS.glob("master*.example.toml")])


@pytest.mark.parametrize("path", DAEMON_EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_legal_as_shipped(path: Path) -> None:
    """In its region, without a licence; the ones for Canada also in the USA, as their comment says."""
    config = load_any(path)
    assert isinstance(config, ClientConfig | MasterConfig)
    assert config.radio.licence is None
    regions = {"CA915": ("CA915", "US915")}.get(str(config.radio.region), (config.radio.region,))
    for region in regions:
        radio = config.radio.model_copy(update={"region": region})
        found = legality(config.model_copy(update={"radio": radio}), path)
        assert (found.violations, found.remedy, found.warning) == ((), None, None)


def test_every_region_has_an_example() -> None:
    """For both daemons."""
    for kind in ("client", "master"):
        configs = [load_any(path) for path in DAEMON_EXAMPLES if path.name.startswith(kind)]
        regions = {
            config.radio.region for config in configs if isinstance(config, ClientConfig | MasterConfig)
        }
        assert regions | {"US915"} == set(REGIONS)


def test_commented_geofence_example_is_valid() -> None:
    """Without the comment signs it is a geofence with the defaults."""
    text = (CONFIGS / "master.example.toml").read_text()
    start = text.index("# [[geofences]]")
    fence = "\n".join(line[2:] for line in text[start : text.index("\n\n", start)].splitlines())
    config = MasterConfig.model_validate_json(json.dumps(tomllib.loads(text + fence)))
    (written,) = config.geofences
    assert written == written.model_copy(update={"sigmas": 3.0, "hysteresis_m": 0.5, "lost_after_s": 2.0})


def test_set_up_examples_are_the_reference_scenario() -> None:
    """They can be used with the simulation."""
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
