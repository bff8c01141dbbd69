"""Scenarios by name, with as many stations as wanted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from tsgt.config import LARGEST_NUMBERS, ScenarioConfig, load
from tsgt.errors import ConfigError

if TYPE_CHECKING:
    from tsgt.config import SimulatedStation

_FILES = Path(__file__).parent / "scenarios"

MOST_STATIONS = LARGEST_NUMBERS["superframe"]

_GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
_EXTRA_STATION_RADIUS_M = 5.0


def scenario_names() -> list[str]:
    """Names of the scenarios that come with the program."""
    return sorted(path.stem for path in _FILES.glob("*.toml"))


def find_scenario(name: str) -> ScenarioConfig:
    """Read a scenario by its name, or from a file of one's own.

    Parameters
    ----------
    name
        One of :func:`scenario_names`, or a path: anything with a slash or with the ending ``.toml``.

    Raises
    ------
    ConfigError
        There is no scenario of that name, or its file cannot be used.
    """
    if "/" in name or name.endswith(".toml"):
        return load(Path(name), ScenarioConfig)
    if name not in scenario_names():
        raise ConfigError(
            f"{name}: no such scenario; there are {', '.join(scenario_names())}, or give the path of a file"
        )
    return load(_FILES / f"{name}.toml", ScenarioConfig)


def with_stations(scenario: ScenarioConfig, count: int) -> ScenarioConfig:
    """Return the scenario with so many stations.

    Those that it lacks stand around the others and track the prisms in turn, each with the instrument of the
    station that tracks the same prism already.
    """
    stations = list(scenario.stations[:count])
    while len(stations) < count:
        stations.append(_extra_station(scenario, len(stations)))
    return scenario.model_copy(update={"stations": tuple(stations)})


def _extra_station(scenario: ScenarioConfig, index: int) -> SimulatedStation:
    like = scenario.stations[index % len(scenario.stations)]
    prism = scenario.prisms[index % len(scenario.prisms)].prism
    numbers = {station.station for station in scenario.stations}
    free = next(n for n in range(1, MOST_STATIONS + 1) if n > index and n not in numbers)
    angle = index * _GOLDEN_ANGLE_RAD
    x, y, z = scenario.stations[0].position_m
    return like.model_copy(
        update={
            "station": free,
            "prism": prism,
            "position_m": (
                x + _EXTRA_STATION_RADIUS_M * math.cos(angle),
                y + _EXTRA_STATION_RADIUS_M * math.sin(angle),
                z + 0.1,
            ),
            "yaw_deg": math.degrees(math.remainder(2 * angle, math.tau)),
        }
    )
