"""Options of a simulated mission in addition to its scenario, and their notation on the command line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from tsgt.config import ClassicMasterConfig, Model, SuperframeMasterConfig
from tsgt.errors import ConfigError
from tsgt.simulation.faults.catalogue import FaultKind
from tsgt.simulation.mission.computer import MASTER

StationSoftware = Literal["ours", "authors"]


@dataclass(frozen=True, slots=True)
class Outage:
    """A time without radio contact between the master and some stations."""

    stations: tuple[int, ...]
    start_s: float
    duration_s: float

    @property
    def end_s(self) -> float:
        """End of the outage."""
        return self.start_s + self.duration_s

    def covers(self, time_s: float) -> bool:
        """Whether the outage is active at this time."""
        return self.start_s <= time_s < self.end_s

    @classmethod
    def parse(cls, text: str, stations: tuple[int, ...]) -> Outage:
        """Parse ``STATIONS:START:SECONDS``; STATIONS is ``all`` or comma-separated numbers.

        Raises
        ------
        ConfigError
            Syntax error, or a station that is not in ``stations``.
        """
        match = re.fullmatch(r"(all|\d+(?:,\d+)*):(\d+(?:\.\d+)?):(\d+(?:\.\d+)?)", text)
        if match is None:
            raise ConfigError(
                f"outage {text!r}: expected STATIONS:START:SECONDS, such as 2:120:60 or all:120:60"
            )
        numbers = stations if match[1] == "all" else tuple(map(int, match[1].split(",")))
        for number in numbers:
            _check_station(number, stations, f"outage {text!r}")
        return cls(numbers, float(match[2]), float(match[3]))


@dataclass(frozen=True, slots=True)
class Restart:
    """A stop and restart of a daemon."""

    station: int | None  # None: the master
    at_s: float

    @classmethod
    def parse(cls, text: str, stations: tuple[int, ...]) -> Restart:
        """Parse ``STATION:AT``; STATION is a number or ``master``. Raises as :meth:`Outage.parse`."""
        match = re.fullmatch(r"(master|\d+):(\d+(?:\.\d+)?)", text)
        if match is None:
            raise ConfigError(f"restart {text!r}: expected STATION:AT, such as 2:120 or master:120")
        if match[1] == MASTER:
            return cls(None, float(match[2]))
        _check_station(int(match[1]), stations, f"restart {text!r}")
        return cls(int(match[1]), float(match[2]))


def _check_station(number: int, stations: tuple[int, ...], where: str) -> None:
    if number not in stations:
        raise ConfigError(f"{where}: there is no station {number}; there are {', '.join(map(str, stations))}")


class SimulationOptions(Model):
    """Options of a mission in addition to its scenario; the command line makes its options from these fields."""

    duration_s: Annotated[float, Field(gt=0)]
    """Duration of the measurements in s."""
    drift_ppm: Annotated[float, Field(ge=-1000, le=1000)] = 10.0
    """Frequency offset of the stations' clocks against the master's; the sign alternates from station to station."""
    drift_ramp_ppm_per_min: Annotated[float, Field(ge=-50, le=50)] = 0.0
    """Slope of a drift ramp, as of a computer that warms up for ten minutes, then cools; the sign alternates as well."""
    stamp_jitter_us: Annotated[float, Field(ge=0, le=10_000)] = 0.0
    """One sigma of the interrupt timestamps of every computer's radio, in addition to the chip's own 3 us."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of all random numbers."""
    station_software: StationSoftware = "ours"
    """Software of the stations: our client, or the authors' node, which speaks classic only."""
    protocol: ClassicMasterConfig | SuperframeMasterConfig = SuperframeMasterConfig(kind="superframe")
    """Protocol of master and stations."""
    authenticated: bool = True
    """Whether all radios share a key; protocol superframe only."""
    outages: tuple[Outage, ...] = ()
    """Times without radio contact."""
    restarts: tuple[Restart, ...] = ()
    """Daemons that end and start again."""
    interference_rate_hz: Annotated[float, Field(ge=0, le=100)] = 0.0
    """Average rate of packets from an interferer on the same channel: noise, and replayed, cut or altered packets."""
    faults: frozenset[FaultKind] = frozenset()
    """Kinds of faults to draw from the seed."""
