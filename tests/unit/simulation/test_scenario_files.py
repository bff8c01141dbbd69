"""The built-in scenarios are found by name and match the paper's description."""

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


def _path_length_m(world: World, duration_s: float) -> float:
    position = world.pose_at(np.arange(0.0, duration_s, 0.2))[:, :3, 3]
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())


def test_scenario_names() -> None:
    """The reference scenario, a static one, and the paper's three sites."""
    assert scenario_names() == ["dynamic", "quarry", "ski-trail", "snowmobile", "static"]


@pytest.mark.parametrize("name", scenario_names())
def test_configuration_files_equal_the_built_in_scenarios(name: str) -> None:
    """The file in configs/ equals the one found by name."""
    assert load(CONFIGS / f"{name}.toml", ScenarioConfig) == find_scenario(name)
    assert find_scenario(name).name == name


def test_path_loads_a_scenario_file(tmp_path: Path) -> None:
    """Anything that looks like a path is read as a file."""
    path = tmp_path / "mine.toml"
    path.write_text('kind = "scenario"\nname = "mine"\n')
    assert find_scenario(str(path)).name == "mine"


def test_unknown_name_is_rejected() -> None:
    """The error lists the known names."""
    with pytest.raises(ConfigError, match="quary: no such scenario; there are dynamic, quarry"):
        find_scenario("quary")


@pytest.mark.parametrize(
    ("name", "length_m", "farthest_m"),
    [("quarry", 200, 130), ("ski-trail", 150, 110), ("snowmobile", 600, 600)],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_route_lengths_match_the_paper(name: str, length_m: float, farthest_m: float, seed: int) -> None:
    """The whole route is driven within the scenario's duration and the range of the instruments."""
    world, duration_s = _world(name, seed)
    assert _path_length_m(world, duration_s) == pytest.approx(length_m, rel=0.02)
    ranges_m = np.linalg.norm(world.pose_at(np.arange(0.0, duration_s, 1.0))[:, :3, 3], axis=1)
    assert ranges_m.min() > 10
    assert ranges_m.max() < farthest_m


def test_static_scenario_does_not_move() -> None:
    """The robot stays at its position."""
    assert _path_length_m(*_world("static")) < 1e-9


def test_only_the_trails_have_occlusions() -> None:
    """Few on the ski trail, many on the snowmobile trail."""

    def hidden(name: str) -> float:
        world, duration_s = _world(name)
        times_s, spans_s = np.arange(0.0, duration_s, 0.5), world.occlusions_s.get(1, np.empty((0, 2)))
        return float(np.mean([np.any((spans_s[:, 0] <= t) & (t < spans_s[:, 1])) for t in times_s]))

    assert hidden("dynamic") == hidden("static") == hidden("quarry") == 0.0
    assert 0.02 < hidden("ski-trail") < 0.15
    assert 0.1 < hidden("snowmobile") < 0.4


def test_more_stations_than_prisms_track_them_in_turn() -> None:
    """Sixteen stations share three prisms evenly and stand apart from each other."""
    stations = with_stations(ScenarioConfig(), 16).stations
    assert [station.station for station in stations] == list(range(1, 17))
    assert [station.prism for station in stations] == [1, 2, 3] * 5 + [1]
    apart_m = [
        math.dist(a.position_m, b.position_m) for i, a in enumerate(stations) for b in stations[i + 1 :]
    ]
    assert min(apart_m) > 1.0
    assert max(apart_m) < 15.0
    assert stations[:3] == ScenarioConfig().stations


def test_fewer_stations_are_a_prefix() -> None:
    """Two stations are the first two of the scenario."""
    assert with_stations(ScenarioConfig(), 2).stations == ScenarioConfig().stations[:2]
