"""The scenarios that come with the program: they are found by name and look as the paper describes them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tsgt.config import ScenarioConfig, load
from tsgt.errors import ConfigError
from tsgt.simulation.scenario_files import find_scenario, scenario_names, with_stations
from tsgt.simulation.world import World, scenario_world

CONFIGS = Path(__file__).parents[3] / "configs" / "scenarios"


def _world(name: str, seed: int = 0) -> tuple[World, float]:
    scenario = find_scenario(name)
    return scenario_world(scenario, scenario.duration_s, np.random.default_rng(seed)), scenario.duration_s


def _way_m(world: World, duration_s: float) -> float:
    position = world.pose_at(np.arange(0.0, duration_s, 0.2))[:, :3, 3]
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())


def test_the_scenarios_are_those_of_the_paper() -> None:
    """Besides the reference scenario there are standing still and the paper's three places."""
    assert scenario_names() == ["dynamic", "quarry", "ski-trail", "snowmobile", "static"]


@pytest.mark.parametrize("name", scenario_names())
def test_configs_and_program_have_the_same_scenarios(name: str) -> None:
    """The file among the configurations is the one that the program finds by its name."""
    assert load(CONFIGS / f"{name}.toml", ScenarioConfig) == find_scenario(name)
    assert find_scenario(name).name == name


def test_a_scenario_of_ones_own_is_found_by_its_path(tmp_path: Path) -> None:
    """Anything that looks like a path is read as a file."""
    path = tmp_path / "mine.toml"
    path.write_text('kind = "scenario"\nname = "mine"\n')
    assert find_scenario(str(path)).name == "mine"


def test_an_unknown_name_is_answered_with_the_known_ones() -> None:
    """Who mistypes a name is told what there is."""
    with pytest.raises(ConfigError, match="quary: no such scenario; there are dynamic, quarry"):
        find_scenario("quary")


@pytest.mark.parametrize(
    ("name", "length_m", "farthest_m"),
    [("quarry", 200, 130), ("ski-trail", 150, 110), ("snowmobile", 600, 600)],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_paths_are_as_long_as_the_paper_says(
    name: str, length_m: float, farthest_m: float, seed: int
) -> None:
    """The whole route is driven in the scenario's time, within the range of the instruments."""
    world, duration_s = _world(name, seed)
    assert _way_m(world, duration_s) == pytest.approx(length_m, rel=0.02)
    ranges_m = np.linalg.norm(world.pose_at(np.arange(0.0, duration_s, 1.0))[:, :3, 3], axis=1)
    assert ranges_m.min() > 10
    assert ranges_m.max() < farthest_m


def test_the_static_scenario_stands() -> None:
    """Nothing moves at all."""
    assert _way_m(*_world("static")) < 1e-9


def test_only_the_forest_hides_the_robot() -> None:
    """Trees hide it on the ski trail now and then, on the snowmobile trail for a good part of the time."""

    def hidden(name: str) -> float:
        world, duration_s = _world(name)
        times_s, spans_s = np.arange(0.0, duration_s, 0.5), world.occlusions_s.get(1, np.empty((0, 2)))
        return float(np.mean([np.any((spans_s[:, 0] <= t) & (t < spans_s[:, 1])) for t in times_s]))

    assert hidden("dynamic") == hidden("static") == hidden("quarry") == 0.0
    assert 0.02 < hidden("ski-trail") < 0.15
    assert 0.1 < hidden("snowmobile") < 0.4


def test_more_stations_than_prisms_track_them_in_turn() -> None:
    """Sixteen stations on three prisms, five or six on each, all at places of their own not far from the others."""
    stations = with_stations(ScenarioConfig(), 16).stations
    assert [station.station for station in stations] == list(range(1, 17))
    assert [station.prism for station in stations] == [1, 2, 3] * 5 + [1]
    apart_m = [
        math.dist(a.position_m, b.position_m) for i, a in enumerate(stations) for b in stations[i + 1 :]
    ]
    assert min(apart_m) > 1.0
    assert max(apart_m) < 15.0
    assert stations[:3] == ScenarioConfig().stations


def test_fewer_stations_are_the_first_ones() -> None:
    """Two stations are the first two of the scenario."""
    assert with_stations(ScenarioConfig(), 2).stations == ScenarioConfig().stations[:2]
