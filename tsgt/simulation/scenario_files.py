"""Scenarios by name, with any number of stations."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from tsgt.config import MAX_STATION_NUMBERS, ScenarioConfig, load
from tsgt.errors import ConfigError

if TYPE_CHECKING:
    from tsgt.config import SimulatedStation

_FILES = Path(__file__).parent / "scenarios"

MAX_STATIONS = MAX_STATION_NUMBERS["superframe"]

_GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
_EXTRA_STATION_RADIUS_M = 5.0


def scenario_names() -> list[str]:
    """Names of the built-in scenarios."""
    return sorted(path.stem for path in _FILES.glob("*.toml"))


def find_scenario(name: str) -> ScenarioConfig:
    """Load a built-in scenario by name, or a scenario file by its path (contains a slash or ends in ``.toml``).

    Raises
    ------
    ConfigError
        There is no such scenario, or its file is invalid.
    """
    if "/" in name or name.endswith(".toml"):
        return load(Path(name), ScenarioConfig)
    if name not in scenario_names():
        raise ConfigError(
            f"{name}: no such scenario; there are {', '.join(scenario_names())}, or give the path of a file"
        )
    return load(_FILES / f"{name}.toml", ScenarioConfig)


def with_stations(scenario: ScenarioConfig, count: int) -> ScenarioConfig:
    """Return the scenario with ``count`` stations.

    Additional stations stand around the first one, track the prisms in turn, and copy the settings of an existing station.
    """
    stations = list(scenario.stations[:count])
    while len(stations) < count:
        stations.append(_extra_station(scenario, len(stations)))
    return scenario.model_copy(update={"stations": tuple(stations)})


def _extra_station(scenario: ScenarioConfig, index: int) -> SimulatedStation:
    template = scenario.stations[index % len(scenario.stations)]
    prism = scenario.prisms[index % len(scenario.prisms)].prism
    numbers = {station.station for station in scenario.stations}
    number = next(n for n in range(1, MAX_STATIONS + 1) if n > index and n not in numbers)
    angle = index * _GOLDEN_ANGLE_RAD
    x, y, z = scenario.stations[0].position_m
    return template.model_copy(
        update={
            "station": number,
            "prism": prism,
            "position_m": (
                x + _EXTRA_STATION_RADIUS_M * math.cos(angle),
                y + _EXTRA_STATION_RADIUS_M * math.sin(angle),
                z + 0.1,
            ),
            "yaw_deg": math.degrees(math.remainder(2 * angle, math.tau)),
        }
    )
